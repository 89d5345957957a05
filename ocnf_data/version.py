"""The version of this package, and of the data sets and checkpoints that record it."""

from typing import Final

__version__: Final = "0.1.0"
