"""A TSDF octree by dense windows, none of which is large: what marching cubes works on.

Around the volume lies a layer of free voxels, so that solids cut off at its border are closed too. *Cells*
are the cubes between 2 x 2 x 2 voxel centres; a window is a cube of cells, together they are all cells, and
neighbours share a layer of voxels. Indices z, y, x of voxels count that layer: the volume begins at 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ocnf_data.arrays import F32, I64, Bool
from ocnf_data.octree.boxes import cut_trees
from ocnf_data.octree.grid import GridOctree

_TREES = 8  # along a window: 64 cells

Place = tuple[int, int, int]


class Windows:
    """The windows of an octree that a surface passes through.

    A value of exactly the level at a voxel would put up to six vertices in one place. `clear` is how far
    from the level, in units of tau, each value is kept: then each vertex has a place of its own.

    Args:
        octree: 1 channel.
        level: what is subtracted of all values.
        clear: least distance of a value from 0 afterwards.
        trees: (GD, GH, GW) which trees count; None: all.
    """

    def __init__(self, octree: GridOctree, level: float, clear: np.float32,
                 trees: Bool | None = None) -> None:
        self.octree, self._level, self._clear = octree, np.float32(level), clear
        self._trees = trees
        self._set: dict[Place, float] = {}
        self.shape = tuple(n + 2 for n in octree.shape)

    def places(self) -> list[Place]:
        """The windows in which values of both signs lie, by their place in the grid of windows."""
        grid = self.octree.trees.shape[:3]
        first = self.octree.prefix[:-1]
        lowest = np.minimum.reduceat(self.octree.data[:, 0], first).reshape(grid) - self._level
        highest = np.maximum.reduceat(self.octree.data[:, 0], first).reshape(grid) - self._level
        lowest, highest = (np.pad(extreme, 1, constant_values=1.0) for extreme in (lowest, highest))
        counted = np.ones(grid, bool) if self._trees is None else self._trees
        counted = np.pad(counted, 1, mode="edge")
        found = []
        for place in np.ndindex(*(-(-n // _TREES) for n in grid)):
            trees = tuple(slice(i * _TREES, (i + 1) * _TREES + 2) for i in place)  # and the trees beside
            if lowest[trees].min() < 0 and highest[trees].max() >= 0 and counted[trees].any():
                found.append((place[0], place[1], place[2]))
        return found

    def corner(self, place: Place) -> I64:
        """First voxel (z, y, x) of a window."""
        return np.array(place, np.int64) * (8 * _TREES)

    def values(self, place: Place) -> F32:
        """The voxels of a window."""
        grid = self.octree.trees.shape[:3]
        low = [max(i * _TREES - 1, 0) for i in place]
        high = [min((i + 1) * _TREES, n) for i, n in zip(place, grid, strict=True)]
        at_start = [i == 0 for i in place]
        at_end = [n == stop for n, stop in zip(grid, high, strict=True)]
        inner = cut_trees(self.octree, low, high).to_dense()[0]
        inner = inner[tuple(slice(0 if start else 7, None) for start in at_start)]
        around = [(int(start), int(end)) for start, end in zip(at_start, at_end, strict=True)]
        values = self._kept_clear(np.pad(inner, around, constant_values=1.0))
        corner = self.corner(place)
        for voxel, value in self._set.items():
            local = np.subtract(voxel, corner)
            if (local >= 0).all() and (local < values.shape).all():
                values[tuple(local)] = value
        return values

    def counted(self, place: Place, shape: Sequence[int]) -> Bool | None:
        """Which cells of a window of that shape count, each at its last voxel, as marching cubes takes it."""
        if self._trees is None:
            return None
        voxels = [first + np.arange(n) for first, n in zip(self.corner(place), shape, strict=True)]
        return self._trees[np.ix_(*(np.clip(i - 1, 0, n - 3) // 8
                                    for i, n in zip(voxels, self.shape, strict=True)))]

    def at(self, voxels: I64) -> F32:
        """Values of voxels (n, 3) z y x, which may lie in the layer around the volume."""
        inside = ((voxels > 0) & (voxels < np.array(self.shape) - 1)).all(axis=1)
        values = np.ones(len(voxels), np.float32)
        values[inside] = self.octree.gather(voxels[inside] - 1)[:, 0]
        values = self._kept_clear(values)
        for i, voxel in enumerate(map(tuple, voxels.tolist())):
            values[i] = self._set.get(voxel, values[i])
        return values

    def make_solid(self, voxel: Place) -> None:
        """Put one voxel just below the level."""
        self._set[voxel] = -float(self._clear)

    def around(self, voxel: Place) -> set[Place]:
        """The windows that a voxel lies in: up to eight."""
        last = [-(-n // _TREES) - 1 for n in self.octree.trees.shape[:3]]
        choices = [{min(i // (8 * _TREES), end), max(min((i - 1) // (8 * _TREES), end), 0)}
                   for i, end in zip(voxel, last, strict=True)]
        return {(z, y, x) for z in choices[0] for y in choices[1] for x in choices[2]}

    def _kept_clear(self, values: F32) -> F32:
        values = values - self._level
        near = np.abs(values) < self._clear
        values[near] = np.where(values[near] < 0, -self._clear, self._clear)
        return values
