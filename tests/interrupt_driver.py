"""A command line that hangs at a function: `python interrupt_driver.py PACKAGE MODULE:NAME ARGUMENTS`.

When the function is called for the first time, the file `$REACHED` appears.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
from pathlib import Path
from typing import Any


def hang(*_: Any, **__: Any) -> None:
    """Say that it is reached, and never return."""
    Path(os.environ["REACHED"]).touch()
    while True:
        time.sleep(0.05)


if __name__ == "__main__":
    package, _, place = sys.argv.pop(1), sys.argv[0], sys.argv.pop(1)
    module, _, name = place.partition(":")
    owner: Any = importlib.import_module(module)
    *above, name = name.split(".")
    for part in above:
        owner = getattr(owner, part)
    setattr(owner, name, hang)
    importlib.import_module(f"{package}.cli").main()
