"""The paper's tables: from a folder of meshes to the paper's own layout, by a declarative file each."""

from typing import Final

WEIGHT_MODELS: Final = 5
"""Validation models that TV-L1's weight is chosen on, unless said otherwise; here, as the command line starts
without the modules that plan."""
