"""`ocnf-data stats`, as a script.

    python tools/shard_stats.py OUT --split test --out stats.png --mad
"""

import sys

from ocnf_data.cli import main

if __name__ == "__main__":
    sys.argv.insert(1, "stats")
    main()
