"""Where a mesh lies in the cube that the cameras look at."""

from __future__ import annotations

from dataclasses import dataclass

from ocnf_data.arrays import F64


@dataclass(frozen=True, eq=False)
class Normalisation:
    """`(vertices - centre) * scale`: from a mesh's own coordinates to metres in the grid's cube."""

    centre: F64
    scale: float

    def apply(self, vertices: F64) -> F64:
        """Map points (N, 3) in the mesh's own coordinates to the cube."""
        return (vertices - self.centre) * self.scale

    def invert(self, points: F64) -> F64:
        """Map points (N, 3) in the cube to the mesh's own coordinates."""
        return points / self.scale + self.centre
