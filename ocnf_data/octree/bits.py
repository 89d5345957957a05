"""One shallow octree of 8^3 voxels in 73 bits: the arithmetic that every other kernel inlines.

A tree is two uint64, `lo` with bits 0..63 and `hi` with bits 64..72; a set bit is a split node.

    bit 0        the root, 8^3 voxels
    bits 1-8     its children, 4^3
    bits 9-72    their children, 2^3
    73-584       the voxels: virtual indices, never stored

    child(i) = 8 i + 1 + k, k = 4 dz + 2 dy + dx;  parent(i) = (i - 1) // 8;  leaves = 1 + 7 * popcount

Leaves are ordered breadth first (width 8 | 4 | 2 | 1), each width in bit order.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numba import njit

from ocnf_data.arrays import F32, I16, I64, U64

TREE_WIDTH = 8
"""Voxels along each axis of a tree."""
MAX_LEAVES = 512
"""Leaves of a tree that is split down to every voxel."""

Word: TypeAlias = np.uint64 | int

_ONE = np.uint64(1)
_BYTE = np.uint64(0xFF)


@njit(cache=True, nogil=True)
def popcount(word: Word) -> int:
    """Number of set bits of a uint64."""
    word = np.uint64(word)
    word -= (word >> _ONE) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True, nogil=True)
def is_split(lo: Word, hi: Word, i: int) -> bool:
    """Whether node `i` (0..72) is split."""
    if i < 64:
        return (np.uint64(lo) >> np.uint64(i)) & _ONE != 0
    return (np.uint64(hi) >> np.uint64(i - 64)) & _ONE != 0


@njit(cache=True, nogil=True)
def with_split(lo: Word, hi: Word, i: int) -> tuple[np.uint64, np.uint64]:
    """The two words with the bit of node `i` (0..72) set."""
    if i < 64:
        return np.uint64(lo) | (_ONE << np.uint64(i)), np.uint64(hi)
    return np.uint64(lo), np.uint64(hi) | (_ONE << np.uint64(i - 64))


@njit(cache=True, nogil=True)
def child_bits(lo: Word, hi: Word, i: int) -> np.uint64:
    """The eight bits of the children of node `i` (0..8), child k in bit k."""
    if i < 7:
        return (np.uint64(lo) >> np.uint64(8 * i + 1)) & _BYTE
    if i == 7:
        return (np.uint64(lo) >> np.uint64(57)) | ((np.uint64(hi) & _ONE) << np.uint64(7))
    return (np.uint64(hi) >> _ONE) & _BYTE


@njit(cache=True, nogil=True)
def splits_below(lo: Word, hi: Word, i: int) -> int:
    """Number of split nodes with an index less than `i` (0..73)."""
    if i < 64:
        return popcount(np.uint64(lo) & ((_ONE << np.uint64(i)) - _ONE))
    return popcount(lo) + popcount(np.uint64(hi) & ((_ONE << np.uint64(i - 64)) - _ONE))


@njit(cache=True, nogil=True)
def leaf_count(lo: Word, hi: Word) -> int:
    """Leaves of a tree, 1..512."""
    return 1 + 7 * (popcount(lo) + popcount(hi))


@njit(cache=True, nogil=True)
def is_tree(lo: Word, hi: Word) -> bool:
    """Whether the bits are a tree: a node is split only if its parent is, and bits 73.. are 0."""
    if np.uint64(hi) >> np.uint64(9) != 0:
        return False
    if not is_split(lo, hi, 0):
        return np.uint64(lo) == 0 and np.uint64(hi) == 0
    orphans = np.uint64(0)
    for i in range(1, 9):
        if not is_split(lo, hi, i):
            orphans |= child_bits(lo, hi, i)
    return orphans == 0


@njit(cache=True, nogil=True)
def leaf_prefix(trees: U64) -> I64:
    """(N, 2) trees -> (N + 1,) int64: index of the first leaf of each tree, and the total at the end."""
    prefix = np.empty(len(trees) + 1, np.int64)
    prefix[0] = 0
    for t in range(len(trees)):
        prefix[t + 1] = prefix[t] + leaf_count(trees[t, 0], trees[t, 1])
    return prefix


@njit(cache=True, nogil=True)
def leaf_of_voxel(lo: Word, hi: Word, z: int, y: int, x: int) -> tuple[int, int]:
    """(leaf, width) at voxel (z, y, x), each 0..7: the leaf's index within the tree and its width."""
    if not is_split(lo, hi, 0):
        return 0, 8
    k = 4 * (z >> 2) + 2 * (y >> 2) + (x >> 2)
    i = 1 + k
    before = splits_below(lo, hi, i) - 1  # split children of the root in front of this one
    if not is_split(lo, hi, i):
        return k - before, 4
    n_split = popcount(child_bits(lo, hi, 0))
    k = 4 * ((z >> 1) & 1) + 2 * ((y >> 1) & 1) + ((x >> 1) & 1)
    j = 8 * i + 1 + k
    before_j = splits_below(lo, hi, j) - 1 - n_split
    if not is_split(lo, hi, j):
        return 8 - n_split + 8 * before + k - before_j, 2
    n_wide = 8 - n_split + 8 * n_split - (popcount(lo) + popcount(hi) - 1 - n_split)
    return n_wide + 8 * before_j + 4 * (z & 1) + 2 * (y & 1) + (x & 1), 1


@njit(cache=True, nogil=True)
def tree_leaves(lo: Word, hi: Word, cells: I16) -> int:
    """Write the leaves' lowest corners and widths, in order, to `cells` (512, 4) int16 as (z, y, x, width).

    Returns the number of leaves.
    """
    if not is_split(lo, hi, 0):
        cells[0, 0], cells[0, 1], cells[0, 2], cells[0, 3] = 0, 0, 0, 8
        return 1
    n_split = popcount(child_bits(lo, hi, 0))
    n4 = 0  # where the next leaf of each width goes: the three widths are filled in one pass
    n2 = 8 - n_split
    n1 = n2 + 8 * n_split - (popcount(lo) + popcount(hi) - 1 - n_split)
    for i in range(1, 9):
        z4, y4, x4 = _corner(i - 1, 4)
        if not is_split(lo, hi, i):
            cells[n4, 0], cells[n4, 1], cells[n4, 2], cells[n4, 3] = z4, y4, x4, 4
            n4 += 1
            continue
        children = child_bits(lo, hi, i)
        for k in range(8):
            dz, dy, dx = _corner(k, 2)
            z2, y2, x2 = z4 + dz, y4 + dy, x4 + dx
            if (children >> np.uint64(k)) & _ONE == 0:
                cells[n2, 0], cells[n2, 1], cells[n2, 2], cells[n2, 3] = z2, y2, x2, 2
                n2 += 1
                continue
            for v in range(8):
                dz, dy, dx = _corner(v, 1)
                cells[n1, 0], cells[n1, 1], cells[n1, 2], cells[n1, 3] = z2 + dz, y2 + dy, x2 + dx, 1
                n1 += 1
    return n1


@njit(cache=True, nogil=True)
def _corner(k: int, width: int) -> tuple[int, int, int]:
    """Offset (z, y, x) of child `k`, `width` voxels wide, within its parent."""
    return width * (k >> 2), width * ((k >> 1) & 1), width * (k & 1)


@njit(cache=True, nogil=True)
def block_structure(values: F32, tolerance: float) -> tuple[np.uint64, np.uint64]:
    """The split rule of SEMANTICS 3 for one tree: (8, 8, 8, C) values [z, y, x, c] -> (lo, hi).

    Top down over widths 8, 4, 2: a node is split iff max - min of some channel over it exceeds `tolerance`.
    """
    lo, hi = np.uint64(0), np.uint64(0)
    if not _varies(values, 0, 0, 0, 8, tolerance):
        return lo, hi
    lo, hi = with_split(lo, hi, 0)
    for i in range(1, 9):
        z, y, x = _corner(i - 1, 4)
        if not _varies(values, z, y, x, 4, tolerance):
            continue
        lo, hi = with_split(lo, hi, i)
        for k in range(8):
            dz, dy, dx = _corner(k, 2)
            if _varies(values, z + dz, y + dy, x + dx, 2, tolerance):
                lo, hi = with_split(lo, hi, 8 * i + 1 + k)
    return lo, hi


@njit(cache=True, nogil=True)
def _varies(values: F32, z0: int, y0: int, x0: int, width: int, tolerance: float) -> bool:
    for c in range(values.shape[3]):
        low = values[z0, y0, x0, c]
        high = low
        for z in range(z0, z0 + width):
            for y in range(y0, y0 + width):
                for x in range(x0, x0 + width):
                    value = values[z, y, x, c]
                    low = min(low, value)
                    high = max(high, value)
            # In float64, where the difference of two float32 of like size is exact.
            if np.float64(high) - np.float64(low) > tolerance:
                return True
    return False


@njit(cache=True, nogil=True)
def block_means(values: F32, lo: Word, hi: Word, out: F32) -> int:
    """Means of (8, 8, 8, C) values [z, y, x, c] over the leaves of a tree, to `out` (>= n, C). Returns n.

    Summed in float64, where the sum of up to 512 equal float32 is exact: their mean is that very value.
    """
    cells = np.empty((MAX_LEAVES, 4), np.int16)
    n = tree_leaves(lo, hi, cells)
    for leaf in range(n):
        z0, y0, x0, width = cells[leaf, 0], cells[leaf, 1], cells[leaf, 2], cells[leaf, 3]
        if width == 1:
            for c in range(values.shape[3]):
                out[leaf, c] = values[z0, y0, x0, c]
            continue
        for c in range(values.shape[3]):
            total = 0.0
            for z in range(z0, z0 + width):
                for y in range(y0, y0 + width):
                    for x in range(x0, x0 + width):
                        total += values[z, y, x, c]
            out[leaf, c] = total / (width * width * width)
    return n


@njit(cache=True, nogil=True)
def pack_block(
    values: F32, tolerance: float, out_data: F32
) -> tuple[np.uint64, np.uint64, int]:
    """One tree from its voxels, as `GridOctree.from_dense` makes it: structure, then the mean of each leaf.

    Args:
        values: (8, 8, 8, C) float32, [z, y, x, c], finite.
        tolerance: largest max - min of a channel within a leaf, in the units of the values.
        out_data: (512, C) float32, receives the leaves.

    Returns:
        (lo, hi, n): the tree's bits and its number of leaves.
    """
    lo, hi = block_structure(values, tolerance)
    n = block_means(values, lo, hi, out_data)
    return lo, hi, n
