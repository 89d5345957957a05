"""Where the structure module splits: voxels near a change of side, as trees at twice the resolution."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import U8, Bool, Prefix, TreeArray
from ocnf_data.octree.bits import TREE_WIDTH, leaf_of_voxel, with_split
from ocnf_model.octree.leaves import tree_at, tree_place

_BELOW, _ABOVE = np.uint8(1), np.uint8(2)


@njit(cache=True, nogil=True, parallel=True)
def surface_trees(
    trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], below: Bool, reach: int
) -> TreeArray:
    """Trees (8 T, 2) at twice the resolution, with every voxel near the surface split into eight.

    Args:
        trees: (T, 2) trees of the reconstruction.
        prefix: `leaf_prefix(trees)`.
        grid: trees along each axis.
        below: (L,) whether each leaf lies below the threshold.
        reach: a voxel is split iff one on the other side lies within this Chebyshev distance; none lies
            outside the grid.
    """
    fine_grid = (2 * grid[0], 2 * grid[1], 2 * grid[2])
    fine = np.zeros((8 * len(trees), 2), np.uint64)  # (8 T, 2)
    sides = _sides_of_trees(prefix, below)  # (T,) bits
    n_around = (reach + TREE_WIDTH - 1) // TREE_WIDTH
    size = TREE_WIDTH + 2 * reach
    for t in prange(len(trees)):
        b, gd, gh, gw = tree_place(t, grid)
        if reach == 0 or not _mixed_around(sides, b, gd, gh, gw, grid, n_around):
            continue
        near = np.empty((size, size, size), np.uint8)
        for z in range(size):
            for y in range(size):
                for x in range(size):
                    gz, gy, gx = 8 * gd + z - reach, 8 * gh + y - reach, 8 * gw + x - reach
                    near[z, y, x] = _side(trees, prefix, grid, sides, below, b, (gz, gy, gx))
        near = _spread(near, reach)
        for z in range(TREE_WIDTH):
            for y in range(TREE_WIDTH):
                for x in range(TREE_WIDTH):
                    if near[z + reach, y + reach, x + reach] == _BELOW | _ABOVE:
                        u = tree_at(b, 2 * gd + z // 4, 2 * gh + y // 4, 2 * gw + x // 4, fine_grid)
                        fine[u, 0], fine[u, 1] = _split_down(fine[u, 0], fine[u, 1], z % 4, y % 4, x % 4)
    return fine


@njit(cache=True, nogil=True)
def _sides_of_trees(prefix: Prefix, below: Bool) -> U8:
    """Which sides occur in each tree, as bits."""
    sides = np.zeros(len(prefix) - 1, np.uint8)
    for t in range(len(sides)):
        for leaf in range(prefix[t], prefix[t + 1]):
            sides[t] |= _BELOW if below[leaf] else _ABOVE
    return sides


@njit(cache=True, nogil=True)
def _mixed_around(sides: U8, b: int, gd: int, gh: int, gw: int,
                  grid: tuple[int, int, int], n_around: int) -> bool:
    """Whether both sides occur in the trees up to `n_around` away."""
    found = np.uint8(0)
    for dz in range(-n_around, n_around + 1):
        for dy in range(-n_around, n_around + 1):
            for dx in range(-n_around, n_around + 1):
                u = tree_at(b, gd + dz, gh + dy, gw + dx, grid)
                if u >= 0:
                    found |= sides[u]
    return bool(found == _BELOW | _ABOVE)


@njit(cache=True, nogil=True)
def _side(trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], sides: U8,
          below: Bool, b: int, voxel: tuple[int, int, int]) -> np.uint8:
    """The side of a voxel (z, y, x) as a bit; 0 outside the grid."""
    z, y, x = voxel
    u = tree_at(b, z >> 3, y >> 3, x >> 3, grid)
    if u < 0:
        return np.uint8(0)
    if sides[u] != _BELOW | _ABOVE:
        return sides[u]
    leaf, _ = leaf_of_voxel(trees[u, 0], trees[u, 1], z & 7, y & 7, x & 7)
    return _BELOW if below[prefix[u] + leaf] else _ABOVE


@njit(cache=True, nogil=True)
def _spread(near: U8, reach: int) -> U8:
    """Bitwise or of each voxel and those within `reach`, axis by axis; exact from `reach` off the faces."""
    size = near.shape[0]
    for _ in range(3):
        turned = np.empty_like(near)  # the last axis becomes the first: three turns bring all back
        for i in range(size):
            for j in range(size):
                for n in range(size):
                    found = near[i, j, n]
                    if reach <= n < size - reach:
                        for m in range(n - reach, n + reach + 1):
                            found |= near[i, j, m]
                    turned[n, i, j] = found
        near = turned
    return near


@njit(cache=True, nogil=True)
def _split_down(lo: np.uint64, hi: np.uint64, z: int, y: int, x: int) -> tuple[np.uint64, np.uint64]:
    """A tree with the node of width 2 at (2 z, 2 y, 2 x), and all above it, split."""
    i = 1 + 4 * (z // 2) + 2 * (y // 2) + x // 2
    lo, hi = with_split(lo, hi, 0)
    lo, hi = with_split(lo, hi, i)
    return with_split(lo, hi, 8 * i + 1 + 4 * (z % 2) + 2 * (y % 2) + x % 2)
