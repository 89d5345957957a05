"""Compiled passes over the leaves of a batch of trees, parallel over the trees.

`trees` are (T, 2) uint64, the grids of a batch one behind the other, each in (gd, gh, gw) C order; `prefix`
is `leaf_prefix(trees)`. Each tree writes to its own place, so results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, I32, I64, U8, Prefix, TreeArray
from ocnf_data.octree.bits import MAX_LEAVES, TREE_WIDTH, leaf_of_voxel, tree_leaves


@njit(cache=True, nogil=True, parallel=True)
def leaf_sizes(trees: TreeArray, prefix: Prefix) -> U8:
    """(L,) uint8: width of each leaf."""
    sizes = np.empty(prefix[-1], np.uint8)  # (L,)
    for t in prange(len(trees)):
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        for leaf in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            sizes[prefix[t] + leaf] = cells[leaf, 3]
    return sizes


@njit(cache=True, nogil=True)
def tree_place(t: int, grid: tuple[int, int, int]) -> tuple[int, int, int, int]:
    """(b, gd, gh, gw) of tree `t`: its grid and its place in it."""
    depth, height, width = grid
    return t // (depth * height * width), t // (height * width) % depth, t // width % height, t % width


@njit(cache=True, nogil=True)
def tree_at(b: int, gd: int, gh: int, gw: int, grid: tuple[int, int, int]) -> int:
    """Index of a tree of grid `b`, or -1 outside the grid."""
    if gd < 0 or gh < 0 or gw < 0 or gd >= grid[0] or gh >= grid[1] or gw >= grid[2]:
        return -1
    return ((b * grid[0] + gd) * grid[1] + gh) * grid[2] + gw


@njit(cache=True, nogil=True, parallel=True)
def voxel_leaves(trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int]) -> I32:
    """(B * D * H * W,) int32: the leaf that holds each voxel; voxels in (b, z, y, x) C order."""
    depth, height, width = TREE_WIDTH * grid[0], TREE_WIDTH * grid[1], TREE_WIDTH * grid[2]
    volume = np.empty((len(trees) // (grid[0] * grid[1] * grid[2]), depth, height, width), np.int32)
    for t in prange(len(trees)):
        b, gd, gh, gw = tree_place(t, grid)
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        for leaf in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            z0, y0, x0 = 8 * gd + cells[leaf, 0], 8 * gh + cells[leaf, 1], 8 * gw + cells[leaf, 2]
            w = cells[leaf, 3]
            volume[b, z0 : z0 + w, y0 : y0 + w, x0 : x0 + w] = prefix[t] + leaf
    return volume.reshape(-1)


@njit(cache=True, nogil=True, parallel=True)
def leaf_voxels(trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int]) -> I32:
    """(L,) int32: the lowest voxel of each leaf, an index into the voxels in (b, z, y, x) C order."""
    voxels = np.empty(prefix[-1], np.int32)  # (L,)
    for t in prange(len(trees)):
        b, gd, gh, gw = tree_place(t, grid)
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        for leaf in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            z, y, x = 8 * gd + cells[leaf, 0], 8 * gh + cells[leaf, 1], 8 * gw + cells[leaf, 2]
            voxels[prefix[t] + leaf] = ((b * 8 * grid[0] + z) * 8 * grid[1] + y) * 8 * grid[2] + x
    return voxels


@njit(cache=True, nogil=True, parallel=True)
def parent_leaves(
    trees: TreeArray, prefix: Prefix, coarse: TreeArray, coarse_prefix: Prefix, grid: tuple[int, int, int],
    shift: int,
) -> I32:
    """The coarse leaf that holds each leaf: (L,) int32, -1 where no coarse leaf holds all of it.

    `grid` is that of `trees`; the coarse trees have the same resolution (`shift` 0) or half of it (1).
    """
    coarse_grid = (grid[0] >> shift, grid[1] >> shift, grid[2] >> shift)
    parents = np.empty(prefix[-1], np.int32)  # (L,)
    for t in prange(len(trees)):
        b, gd, gh, gw = tree_place(t, grid)
        u = tree_at(b, gd >> shift, gh >> shift, gw >> shift, coarse_grid)
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        for leaf in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            z = ((8 * gd + cells[leaf, 0]) >> shift) % 8
            y = ((8 * gh + cells[leaf, 1]) >> shift) % 8
            x = ((8 * gw + cells[leaf, 2]) >> shift) % 8
            parent, width = leaf_of_voxel(coarse[u, 0], coarse[u, 1], z, y, x)
            fits = (width << shift) >= cells[leaf, 3]
            parents[prefix[t] + leaf] = coarse_prefix[u] + parent if fits else -1
    return parents


@njit(cache=True, nogil=True, parallel=True)
def count_overlaps(trees: TreeArray, prefix: Prefix, other: TreeArray) -> I64:
    """(L,): how many leaves of the other trees, at the same resolution, share voxels with each leaf."""
    counts = np.empty(prefix[-1], np.int64)  # (L,)
    for t in prange(len(trees)):
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        for leaf in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            inside = 0
            z0, y0, x0, w = cells[leaf, 0], cells[leaf, 1], cells[leaf, 2], cells[leaf, 3]
            for z in range(z0, z0 + w):
                for y in range(y0, y0 + w):
                    for x in range(x0, x0 + w):
                        _, width = leaf_of_voxel(other[t, 0], other[t, 1], z, y, x)
                        inside += ((z | y | x) & (min(width, w) - 1)) == 0
            counts[prefix[t] + leaf] = inside
    return counts


@njit(cache=True, nogil=True, parallel=True)
def fill_overlaps(
    trees: TreeArray, prefix: Prefix, other: TreeArray, other_prefix: Prefix, starts: I64
) -> tuple[I32, F32]:
    """The leaves of `count_overlaps`, (N,) int32, and the share of the leaf in each, (N,) float32.

    Those of leaf i are entries starts[i] to starts[i + 1].
    """
    columns = np.empty(starts[-1], np.int32)  # (N,)
    shares = np.empty(starts[-1], np.float32)  # (N,)
    for t in prange(len(trees)):
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        for leaf in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            entry = starts[prefix[t] + leaf]
            z0, y0, x0, w = cells[leaf, 0], cells[leaf, 1], cells[leaf, 2], cells[leaf, 3]
            for z in range(z0, z0 + w):
                for y in range(y0, y0 + w):
                    for x in range(x0, x0 + w):
                        found, width = leaf_of_voxel(other[t, 0], other[t, 1], z, y, x)
                        common = min(width, w)
                        if (z | y | x) & (common - 1) == 0:  # the lowest corner of the overlap
                            columns[entry] = other_prefix[t] + found
                            shares[entry] = (common / w) ** 3
                            entry += 1
    return columns, shares


@njit(cache=True, nogil=True)
def transpose(
    columns: I32, starts: I64, n_columns: int
) -> tuple[I64, I32, I64]:
    """The columns of a sparse matrix in rows: where they start, the row of each entry, and its old place."""
    column_starts = np.zeros(n_columns + 1, np.int64)
    for column in columns:
        column_starts[column + 1] += 1
    column_starts = np.cumsum(column_starts)
    cursor = column_starts[:-1].copy()
    rows = np.empty(len(columns), np.int32)
    places = np.empty(len(columns), np.int64)
    for row in range(len(starts) - 1):
        for place in range(starts[row], starts[row + 1]):
            column = columns[place]
            rows[cursor[column]] = row
            places[cursor[column]] = place
            cursor[column] += 1
    return column_starts, rows, places
