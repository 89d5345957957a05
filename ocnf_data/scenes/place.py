"""Putting things where there is room for them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.shapes import make_shape
from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import Part

_GAP = 0.01  # metres between the boxes of two things
_TRIES = 30
_INDEX = 2**31 - 1  # shapes in scenes are drawn from this many of each category


class Draft:
    """The things placed so far.

    Attributes:
        parts: (thing, its name) in order; `shell` is what the others stand in or on.
    """

    def __init__(self, seed: int, split: str) -> None:
        self._seed, self._split = seed, split
        self.parts: list[tuple[Part, str]] = []
        self._boxes: list[tuple[F64, F64]] = []

    def shell(self, *parts: Part) -> None:
        """Add walls, a floor, a table's top: things may touch it."""
        self.parts += [(part, "shell") for part in parts]

    def shape(self, draw: Draw, category: str) -> Part:
        """A procedural shape of the category, standing on z = 0 about the z axis."""
        mesh = make_shape(category, self._seed, draw.count(0, _INDEX), f"scene-{self._split}")
        return settled(Part(mesh.vertices, mesh.faces))

    def put(self, draw: Draw, part: Part, name: str, low: Sequence[float], high: Sequence[float],
            z: float = 0.0) -> Part | None:
        """Place a part in the rectangle from low (x, y) to high, standing on z, where nothing else is.

        Returns:
            the part where it stands now; None where no free place was found, and nothing was added.
        """
        a, b = part.vertices.min(axis=0), part.vertices.max(axis=0)
        room = np.subtract(high, low) - (b - a)[:2]
        if (room < -1e-9).any():
            return None
        for _ in range(_TRIES):
            corner = np.array([draw.between(low[i], low[i] + room[i]) for i in range(2)])
            x, y = (corner - a[:2]).tolist()
            placed = part.move(x, y, z - a[2])
            if self.stand(placed, name):
                return placed
        return None

    def stand(self, part: Part, name: str) -> bool:
        """Add a part that stands where it shall, if its box keeps apart from all others; whether it did."""
        a, b = part.vertices.min(axis=0), part.vertices.max(axis=0)
        for low, high in self._boxes:
            if (a < high + _GAP).all() and (b > low - _GAP).all() and not (
                    np.isclose(a[2], high[2], atol=1e-6) or np.isclose(b[2], low[2], atol=1e-6)):
                return False
        self.parts.append((part, name))
        self._boxes.append((a, b))
        return True


def settled(part: Part) -> Part:
    """The part on z = 0 with the middle of its box on the z axis."""
    a, b = part.vertices.min(axis=0), part.vertices.max(axis=0)
    middle = (a + b) / 2
    return part.move(-middle[0], -middle[1], -a[2])


def sized(part: Part, longest: float) -> Part:
    """The part scaled so that the longest side of its box is `longest` metres."""
    factor = longest / float(np.ptp(part.vertices, axis=0).max())
    return part.scale(factor, factor, factor)
