"""Boxes of whole trees: cut out of an octree, and put together to one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ocnf_data.arrays import F32, I64
from ocnf_data.errors import OcnfError
from ocnf_data.octree.grid import GridOctree

Trees = tuple[int, int, int]


def cut_trees(octree: GridOctree, low: Sequence[int], high: Sequence[int]) -> GridOctree:
    """The box of trees from `low` up to before `high`, (gd, gh, gw); no value changes."""
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    grid = octree.trees.shape[:3]
    number = np.arange(int(np.prod(grid)), dtype=np.int64).reshape(grid)[box].ravel()
    first, counts = octree.prefix[number], np.diff(octree.prefix)[number]
    return GridOctree.trusted(np.ascontiguousarray(octree.trees[box]), octree.data[_rows(first, counts)])


def join_trees(grid: Trees, boxes: Sequence[tuple[Trees, GridOctree]]) -> GridOctree:
    """One octree of boxes that tile a grid of trees.

    Args:
        grid: trees along z, y, x.
        boxes: the first tree of each box, and the box.

    Raises:
        OcnfError: the boxes do not hold each tree once.
    """
    trees = np.zeros((*grid, 2), np.uint64)
    counts = np.zeros(grid, np.int64)
    for low, box in boxes:
        place = _place(low, box)
        if counts[place].shape != box.trees.shape[:3] or counts[place].any():
            raise OcnfError("boxes overlap or reach out of the grid", code="structure", where="join_trees",
                            found=f"{box.trees.shape[:3]} at {low}", expected=f"within {grid}")
        trees[place] = box.trees
        counts[place] = np.diff(box.prefix).reshape(box.trees.shape[:3])
    if not counts.all():
        raise OcnfError("boxes leave a gap", code="structure", where="join_trees", found=f"{grid} trees")
    first = (np.cumsum(counts) - counts.ravel()).reshape(grid)
    data: F32 = np.empty((int(counts.sum()), boxes[0][1].channels), np.float32)
    for low, box in boxes:
        place = _place(low, box)
        data[_rows(first[place].ravel(), counts[place].ravel())] = box.data
    return GridOctree.trusted(trees, data)


def _place(low: Trees, box: GridOctree) -> tuple[slice, ...]:
    return tuple(slice(a, a + n) for a, n in zip(low, box.trees.shape[:3], strict=True))


def _rows(first: I64, counts: I64) -> I64:
    """first[0], first[0] + 1, ..., counts[0] of them; then those of first[1], ..."""
    ends = np.cumsum(counts)
    return np.asarray(np.arange(ends[-1]) + np.repeat(first - (ends - counts), counts))
