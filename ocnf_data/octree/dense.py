"""Compiled passes between dense volumes and grids of trees.

Dense volumes are (C, D, H, W) float32 in C order; trees are (T, 2) uint64, the grid's (GD, GH, GW) flattened;
`prefix` is `leaf_prefix(trees)`. What reads or writes voxels is parallel over the trees; each writes to its
own place, so results do not depend on the number of threads. What only looks at trees and leaves is serial.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit, prange

from ocnf_data.arrays import F32, I32, I64, U8, U32, Prefix, TreeArray
from ocnf_data.octree.bits import (
    MAX_LEAVES,
    TREE_WIDTH,
    block_means,
    block_structure,
    is_tree,
    leaf_of_voxel,
    tree_leaves,
)
from ocnf_data.octree.threads import in_threads


@in_threads
def tree_extremes(values: F32) -> tuple[F32, F32, bool]:
    """Smallest and largest value over each tree, (T, C) float32 each, and whether every value is finite."""
    n_channels, depth, height, width = values.shape
    gd, gh, gw = depth // TREE_WIDTH, height // TREE_WIDTH, width // TREE_WIDTH
    low = np.empty((gd * gh * gw, n_channels), np.float32)
    high = np.empty((gd * gh * gw, n_channels), np.float32)
    finite = np.ones(gd * gh, np.bool_)
    for row in prange(gd * gh):
        z0, y0 = TREE_WIDTH * (row // gh), TREE_WIDTH * (row % gh)
        row_low, row_high = np.empty(width, np.float32), np.empty(width, np.float32)
        poison = np.zeros(width, np.float32)  # v - v is 0 where v is finite, else NaN
        for c in range(n_channels):
            row_low[:] = values[c, z0, y0]
            row_high[:] = values[c, z0, y0]
            for z in range(z0, z0 + TREE_WIDTH):
                for y in range(y0, y0 + TREE_WIDTH):
                    line = values[c, z, y]
                    for x in range(width):
                        v = line[x]
                        row_low[x] = v if v < row_low[x] else row_low[x]
                        row_high[x] = v if v > row_high[x] else row_high[x]
                        poison[x] += v - v
            for g in range(gw):
                low[row * gw + g, c] = row_low[TREE_WIDTH * g : TREE_WIDTH * (g + 1)].min()
                high[row * gw + g, c] = row_high[TREE_WIDTH * g : TREE_WIDTH * (g + 1)].max()
        for x in range(width):
            if poison[x] != 0:
                finite[row] = False
    return low, high, bool(finite.all())


@in_threads
def split_trees(values: F32, low: F32, high: F32, tolerance: float) -> TreeArray:
    """Bits of each tree by the split rule, (T, 2) uint64; `low` and `high` are its `tree_extremes`."""
    n_channels, _, height, width = values.shape
    gh, gw = height // TREE_WIDTH, width // TREE_WIDTH
    zyxc = values.transpose((1, 2, 3, 0))
    trees = np.zeros((len(low), 2), np.uint64)
    for t in prange(len(low)):
        mixed = False
        for c in range(n_channels):
            mixed = mixed or bool(np.float64(high[t, c]) - np.float64(low[t, c]) > tolerance)
        if mixed:
            trees[t, 0], trees[t, 1] = block_structure(_block(zyxc, t, gh, gw), tolerance)
    return trees


@in_threads
def mean_leaves(
    values: F32, low: F32, high: F32, trees: TreeArray, prefix: Prefix
) -> F32:
    """Means over the leaves of the trees, (n_leaves, C) float32."""
    n_channels, _, height, width = values.shape
    gh, gw = height // TREE_WIDTH, width // TREE_WIDTH
    zyxc = values.transpose((1, 2, 3, 0))
    data = np.empty((prefix[-1], n_channels), np.float32)
    for t in prange(len(trees)):
        leaves = data[prefix[t] : prefix[t + 1]]
        constant = True
        for c in range(n_channels):
            constant = constant and low[t, c] == high[t, c]
        if constant:  # most trees: no need to read the volume again
            leaves[:] = low[t]
        else:
            block_means(_block(zyxc, t, gh, gw), trees[t, 0], trees[t, 1], leaves)
    return data


@njit(cache=True, nogil=True)
def _block(zyxc: F32, t: int, gh: int, gw: int) -> F32:
    """The (8, 8, 8, C) view of tree `t` in a (D, H, W, C) volume."""
    z, y, x = first_voxel(t, gh, gw)
    return zyxc[z : z + TREE_WIDTH, y : y + TREE_WIDTH, x : x + TREE_WIDTH]


@njit(cache=True, nogil=True)
def first_voxel(t: int, gh: int, gw: int) -> tuple[int, int, int]:
    """Lowest voxel (z, y, x) of tree `t` of a grid with `gh` x `gw` trees a layer."""
    return TREE_WIDTH * (t // (gh * gw)), TREE_WIDTH * (t // gw % gh), TREE_WIDTH * (t % gw)


@in_threads
def paint(trees: TreeArray, prefix: Prefix, data: npt.NDArray, volume: npt.NDArray) -> None:
    """Write each leaf's row of `data` (n_leaves, C) to its voxels in `volume` (C, D, H, W), same dtype."""
    n_channels, _, height, width = volume.shape
    gh, gw = height // TREE_WIDTH, width // TREE_WIDTH
    for t in prange(len(trees)):
        z0, y0, x0 = first_voxel(t, gh, gw)
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        n = tree_leaves(trees[t, 0], trees[t, 1], cells)
        for c in range(n_channels):
            for leaf in range(n):
                value = data[prefix[t] + leaf, c]
                w = cells[leaf, 3]
                for z in range(z0 + cells[leaf, 0], z0 + cells[leaf, 0] + w):
                    for y in range(y0 + cells[leaf, 1], y0 + cells[leaf, 1] + w):
                        for x in range(x0 + cells[leaf, 2], x0 + cells[leaf, 2] + w):
                            volume[c, z, y, x] = value


@njit(cache=True, nogil=True)
def locate_leaves(
    trees: TreeArray, prefix: Prefix, gh: int, gw: int
) -> tuple[I32, U8]:
    """Lowest voxel (z, y, x) of each leaf, (n_leaves, 3) int32, and its width, (n_leaves,) uint8."""
    corners = np.empty((prefix[-1], 3), np.int32)
    widths = np.empty(prefix[-1], np.uint8)
    cells = np.empty((MAX_LEAVES, 4), np.int16)
    for t in range(len(trees)):
        z0, y0, x0 = first_voxel(t, gh, gw)
        n = tree_leaves(trees[t, 0], trees[t, 1], cells)
        for leaf in range(n):
            row = prefix[t] + leaf
            corners[row, 0] = z0 + cells[leaf, 0]
            corners[row, 1] = y0 + cells[leaf, 1]
            corners[row, 2] = x0 + cells[leaf, 2]
            widths[row] = cells[leaf, 3]
    return corners, widths


@in_threads
def leaves_at(
    trees: TreeArray, prefix: Prefix, gh: int, gw: int, zyx: I64
) -> I64:
    """Index of the leaf that holds each of the voxels `zyx` (N, 3), which lie inside: (N,) int64."""
    leaves = np.empty(len(zyx), np.int64)
    for n in prange(len(zyx)):
        z, y, x = zyx[n, 0], zyx[n, 1], zyx[n, 2]
        t = (z // TREE_WIDTH * gh + y // TREE_WIDTH) * gw + x // TREE_WIDTH
        leaf, _ = leaf_of_voxel(
            trees[t, 0], trees[t, 1], z % TREE_WIDTH, y % TREE_WIDTH, x % TREE_WIDTH
        )
        leaves[n] = prefix[t] + leaf
    return leaves


@njit(cache=True, nogil=True)
def first_bad_tree(trees: TreeArray) -> int:
    """Index of the first entry of (T, 2) whose bits are no tree, or -1."""
    for t in range(len(trees)):
        if not is_tree(trees[t, 0], trees[t, 1]):
            return t
    return -1


@njit(cache=True, nogil=True)
def all_finite(words: U32) -> bool:
    """Whether float32 values, given as a flat uint32 view, are all finite: an integer loop vectorises."""
    exponent = np.uint32(0x7F800000)
    n_bad = 0
    for i in range(len(words)):
        n_bad += (words[i] & exponent) == exponent
    return n_bad == 0
