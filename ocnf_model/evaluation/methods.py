"""The methods that are compared, by name, and TV-L1's weights. Imports nothing heavy, for command lines."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Final

from ocnf_data.errors import OcnfError


class Method(StrEnum):
    """A way from depth views to a TSDF."""

    VOLFUS = "volfus"
    TVL1 = "tvl1"
    OURS = "ours"

    @property
    def label(self) -> str:
        """The name in tables and figures."""
        return {"volfus": "VolFus", "tvl1": "TV-L1", "ours": "Ours"}[self.value]


def parse_methods(names: Sequence[str]) -> tuple[Method, ...]:
    """The methods of some names, each once, in the order of `Method`.

    Raises:
        OcnfError: an unknown name.
    """
    for name in names:
        if name not in tuple(Method):
            raise OcnfError("no such method", field="methods", found=name, expected=" or ".join(Method))
    return tuple(method for method in Method if method in names)


DEFAULT_WEIGHTS: Final[dict[int, float]] = {64: 2.5, 128: 1.6, 256: 1.6}
"""TV-L1's weights where none was chosen for the data at hand: those of `pretrained/tvl1.json` (real meshes, 4
views, sigma 0.02), and the best ones for the demo's procedural shapes too."""


def default_weight(resolution: int) -> float:
    """TV-L1's weight at a resolution, or at the nearest one that there is a weight for."""
    return DEFAULT_WEIGHTS[min(DEFAULT_WEIGHTS, key=lambda known: abs(known - resolution))]
