"""`ocnf-data show`, as a script.

    python tools/show_sample.py OUT --key chair_0007 --variant v4_n02
"""

import sys

from ocnf_data.cli import main

if __name__ == "__main__":
    sys.argv.insert(1, "show")
    main()
