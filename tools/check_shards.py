"""`ocnf-data check`, as a script.

    python tools/check_shards.py OUT --meshes ROOT --samples 20 --cells 20000
"""

import sys

from ocnf_data.cli import main

if __name__ == "__main__":
    sys.argv.insert(1, "check")
    main()
