"""What a 3x3x3 convolution reads: which leaves, and with what weight.

For a leaf c and an offset k = 9 kz + 3 ky + kx (k - 1 = -1, 0, 1 along each axis), row (c, k) of the overlap
matrix holds, for each leaf l, the fraction of the voxels v of c for which v + k - 1 lies in l. Voxels outside
the grid count for nothing.

The leaves of a tree come in three kinds, in this order: *wide* ones, 8 or 4 voxels wide, whose rows are kept
as a sparse matrix; *twos*, 2 voxels wide; and *octets*, the eight voxels of a divided node, whose rows have a
single entry of 1 each. For a two and for an octet it is enough to know the leaves at the 4x4x4 voxels in and
around it: the rows of a two are means over 2x2x2 of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ocnf_data.arrays import F32, I16, I32, I64, Prefix, TreeArray
from ocnf_data.octree.bits import MAX_LEAVES, child_bits, is_split, leaf_of_voxel, popcount, tree_leaves
from ocnf_model.octree.leaves import tree_at, tree_place
from ocnf_model.octree.structure import Structure

N_OFFSETS = 27
N_AROUND = 64  # voxels in and around an octet or a two
HALO = 10  # a tree and one voxel around it
_WIDE, _TWOS, _OCTETS = 0, 1, 2
Corner: TypeAlias = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The overlap matrix of a structure with L leaves: O octets, W twos and I wide leaves.

    Attributes:
        octets, twos: (O, 64) and (W, 64) int32, the leaf at each voxel (z, y, x) in and around one; L outside
            the grid.
        voxels, two_wide, wide: (8 O,), (W,) and (I,) int64, the leaves of width 1, of width 2 and the others,
            each in order.
        near: (U,) int64, the leaves that some wide leaf reads, in order.
        starts: (27 I + 1,) int32, row (i, k) has the entries starts[27 i + k] to starts[27 i + k + 1].
        columns, weights: (N,) int32 and float32, which of the leaves `near` an entry is, and its fraction.
    """

    octets: Tensor
    twos: Tensor
    voxels: Tensor
    two_wide: Tensor
    wide: Tensor
    near: Tensor
    starts: Tensor
    columns: Tensor
    weights: Tensor

    @classmethod
    def build(cls, structure: Structure) -> Neighbours:
        """Compute the matrix on the CPU."""
        trees, prefix, grid = structure.flat, structure.prefix, structure.grid
        before = kinds_before(trees)  # (T + 1, 3)
        starts = np.zeros(N_OFFSETS * int(before[-1, _WIDE]) + 1, np.int64)  # (27 I + 1,)
        count_wide(trees, prefix, grid, before, starts[1:])
        np.cumsum(starts, out=starts)
        octets, twos, columns, weights = fill(trees, prefix, grid, before, starts)
        near = among_near(columns, int(prefix[-1]))
        sizes = structure.sizes
        voxels, two_wide, wide = (np.flatnonzero(of) for of in (sizes == 1, sizes == 2, sizes > 2))
        return cls(*(torch.from_numpy(array) for array in (
            octets, twos, voxels, two_wide, wide, near, starts.astype(np.int32), columns, weights)))

    def to(self, device: torch.device) -> Neighbours:
        """The tables on a device."""
        return Neighbours(**{name: tensor.to(device) for name, tensor in vars(self).items()})


@njit(cache=True, nogil=True)
def kinds_before(trees: TreeArray) -> I64:
    """(T + 1, 3): the wide leaves, twos and octets in the trees before each, and in all."""
    before = np.zeros((len(trees) + 1, 3), np.int64)
    for t in range(len(trees)):
        lo, hi = trees[t]
        divided = popcount(child_bits(lo, hi, 0))  # nodes of width 4, and below those of width 2
        octets = popcount(lo >> np.uint64(9)) + popcount(hi)
        before[t + 1, _WIDE] = before[t, _WIDE] + (8 - divided if is_split(lo, hi, 0) else 1)
        before[t + 1, _TWOS] = before[t, _TWOS] + 8 * divided - octets
        before[t + 1, _OCTETS] = before[t, _OCTETS] + octets
    return before


@njit(cache=True, nogil=True)
def _halo_range(d: int) -> tuple[int, int]:
    """Halo coordinates, those of the tree plus 1, of the tree's neighbour at d = -1, 0, 1."""
    return (0, 1) if d < 0 else (1, 9) if d == 0 else (9, 10)


@njit(cache=True, nogil=True)
def _paint_halo(
    trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], t: int, leaves: I32, widths: I32
) -> None:
    """Leaf and leaf width at the 10^3 voxels in and around tree `t`; leaf -1 outside the grid."""
    b, gd, gh, gw = tree_place(t, grid)
    for dz in range(-1, 2):
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                u = tree_at(b, gd + dz, gh + dy, gw + dx, grid)
                single = u < 0 or not is_split(trees[u, 0], trees[u, 1], 0)
                leaf, width = (-1, 1) if u < 0 else (0, 8)
                first = 0 if u < 0 else prefix[u]
                for z in range(*_halo_range(dz)):
                    for y in range(*_halo_range(dy)):
                        for x in range(*_halo_range(dx)):
                            if not single:
                                leaf, width = leaf_of_voxel(trees[u, 0], trees[u, 1], (z - 1) % 8,
                                                            (y - 1) % 8, (x - 1) % 8)
                            leaves[z, y, x] = first + leaf
                            widths[z, y, x] = width


@njit(cache=True, nogil=True)
def _overlap(low: int, high: int, start: int, width: int) -> int:
    """Length of what [low, high) and [start, start + width) share."""
    return max(0, min(high, start + width) - max(low, start))


@njit(cache=True, nogil=True)
def _add_overlap(row: I32, leaf: int, first: Corner, wide: int, other: Corner, w: int) -> None:
    """A row of `found`: a leaf of width `wide` whose first voxel is `first`, against one of width `w`.

    The row is (leaf, overlap along z at kz = 0, 1, 2, along y, along x); `first` and `other` are halo
    coordinates, those of `other` 1 less, so that offset k moves it by k.
    """
    (z, y, x), (z0, y0, x0) = first, other
    row[0] = leaf
    for k in range(3):
        row[1 + k] = _overlap(z, z + wide, z0 + k, w)
        row[4 + k] = _overlap(y, y + wide, y0 + k, w)
        row[7 + k] = _overlap(x, x + wide, x0 + k, w)


@njit(cache=True, nogil=True)
def _around_leaf(cell: I16, leaves: I32, widths: I32, found: I32) -> int:
    """Rows of `found` (1000, 10) for the leaves that touch a leaf, itself included: how many there are."""
    own, w = (cell[0], cell[1], cell[2]), cell[3]
    n = 0
    for z in range(cell[0], cell[0] + w + 2):
        for y in range(cell[1], cell[1] + w + 2):
            for x in range(cell[2], cell[2] + w + 2):
                if leaves[z, y, x] < 0:
                    continue
                wide = widths[z, y, x]
                z0, y0, x0 = ((z - 1) & -wide) + 1, ((y - 1) & -wide) + 1, ((x - 1) & -wide) + 1
                # Each leaf counts once, at its lowest voxel within reach.
                if z == max(z0, cell[0]) and y == max(y0, cell[1]) and x == max(x0, cell[2]):
                    _add_overlap(found[n], leaves[z, y, x], (z0, y0, x0), wide, own, w)
                    n += 1
    return n


@njit(cache=True, nogil=True)
def _around_tree(
    trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], t: int, found: I32
) -> int:
    """What `_around_leaf` does, for a tree of one leaf: most of its neighbours are such trees too."""
    b, gd, gh, gw = tree_place(t, grid)
    n = 0
    for dz in range(-1, 2):
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                u = tree_at(b, gd + dz, gh + dy, gw + dx, grid)
                if u < 0:
                    continue
                if not is_split(trees[u, 0], trees[u, 1], 0):
                    _add_overlap(found[n], prefix[u], (8 * dz + 1, 8 * dy + 1, 8 * dx + 1), 8, (0, 0, 0), 8)
                    n += 1
                    continue
                z_low, z_high = _halo_range(dz)
                y_low, y_high = _halo_range(dy)
                x_low, x_high = _halo_range(dx)
                for z in range(z_low, z_high):
                    for y in range(y_low, y_high):
                        for x in range(x_low, x_high):
                            leaf, wide = leaf_of_voxel(trees[u, 0], trees[u, 1], (z - 1) % 8, (y - 1) % 8,
                                                       (x - 1) % 8)
                            z0, y0, x0 = ((z - 1) & -wide) + 1, ((y - 1) & -wide) + 1, ((x - 1) & -wide) + 1
                            if z == max(z0, z_low) and y == max(y0, y_low) and x == max(x0, x_low):
                                _add_overlap(found[n], prefix[u] + leaf, (z0, y0, x0), wide, (0, 0, 0), 8)
                                n += 1
    return n


@njit(cache=True, nogil=True, parallel=True)
def count_wide(
    trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], before: I64, counts: I64
) -> None:
    """Add the number of entries of each row (i, k) of the wide leaves to `counts` (27 I,)."""
    for t in prange(len(trees)):
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        n = tree_leaves(trees[t, 0], trees[t, 1], cells)
        n_wide = before[t + 1, _WIDE] - before[t, _WIDE]
        row = N_OFFSETS * before[t, _WIDE]
        found = np.empty((HALO**3, 10), np.int32)  # (1000, 10)
        leaves, widths = np.empty((HALO, HALO, HALO), np.int32), np.empty((HALO, HALO, HALO), np.int32)
        if n > 1 and n_wide:
            _paint_halo(trees, prefix, grid, t, leaves, widths)
        for i in range(n_wide):
            n_found = _around_leaf(cells[i], leaves, widths, found) if n > 1 \
                else _around_tree(trees, prefix, grid, t, found)
            for m in range(n_found):
                for kz in range(3):
                    for ky in range(3):
                        if found[m, 1 + kz] * found[m, 4 + ky] > 0:
                            for kx in range(3):
                                counts[row + 9 * kz + 3 * ky + kx] += found[m, 7 + kx] > 0
            row += N_OFFSETS


@njit(cache=True, nogil=True, parallel=True)
def fill(
    trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], before: I64, starts: I64
) -> tuple[I32, I32, I32, F32]:
    """`octets`, `twos`, `columns` and `weights`, as in `Neighbours`."""
    octets = np.empty((before[-1, _OCTETS], N_AROUND), np.int32)  # (O, 64)
    twos = np.empty((before[-1, _TWOS], N_AROUND), np.int32)  # (W, 64)
    columns = np.empty(starts[-1], np.int32)  # (N,)
    weights = np.empty(starts[-1], np.float32)  # (N,)
    for t in prange(len(trees)):
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        n = tree_leaves(trees[t, 0], trees[t, 1], cells)
        n_wide = before[t + 1, _WIDE] - before[t, _WIDE]
        n_twos = before[t + 1, _TWOS] - before[t, _TWOS]
        leaves, widths = np.empty((HALO, HALO, HALO), np.int32), np.empty((HALO, HALO, HALO), np.int32)
        found = np.empty((HALO**3, 10), np.int32)  # (1000, 10)
        if n > 1:
            _paint_halo(trees, prefix, grid, t, leaves, widths)
        row = N_OFFSETS * before[t, _WIDE]
        for i in range(n_wide):
            n_found = _around_leaf(cells[i], leaves, widths, found) if n > 1 \
                else _around_tree(trees, prefix, grid, t, found)
            _fill_rows(found[:n_found], starts[row : row + N_OFFSETS].copy(), cells[i, 3], columns, weights)
            row += N_OFFSETS
        for i in range(n_twos):
            _copy_around(leaves, cells[n_wide + i], prefix[-1], twos[before[t, _TWOS] + i])
        for i in range(before[t + 1, _OCTETS] - before[t, _OCTETS]):
            _copy_around(leaves, cells[n_wide + n_twos + 8 * i], prefix[-1], octets[before[t, _OCTETS] + i])
    return octets, twos, columns, weights


@njit(cache=True, nogil=True)
def _copy_around(leaves: I32, cell: I16, outside: int, around: I32) -> None:
    """Write the leaves at the 4^3 voxels in and around 2^3, whose first has the corner in `cell`."""
    z, y, x = cell[0], cell[1], cell[2]
    cube = leaves[z : z + 4, y : y + 4, x : x + 4].copy().reshape(N_AROUND)
    for v in range(N_AROUND):
        around[v] = cube[v] if cube[v] >= 0 else outside


@njit(cache=True, nogil=True)
def _fill_rows(found: I32, cursor: I64, w: int, columns: I32, weights: F32) -> None:
    """The 27 rows of a leaf of width w, from `found`; row k begins at entry cursor[k]."""
    for m in range(len(found)):
        for kz in range(3):
            for ky in range(3):
                area = found[m, 1 + kz] * found[m, 4 + ky]
                if area == 0:
                    continue
                for kx in range(3):
                    if found[m, 7 + kx] > 0:
                        k = 9 * kz + 3 * ky + kx
                        columns[cursor[k]] = found[m, 0]
                        weights[cursor[k]] = area * found[m, 7 + kx] / (w * w * w)
                        cursor[k] += 1


@njit(cache=True, nogil=True, parallel=True)
def among_near(columns: I32, n_leaves: int) -> I64:
    """The leaves that occur in `columns` (N,), in order, (U,); each entry becomes its place among them."""
    place = np.zeros(n_leaves, np.int32)
    for j in prange(len(columns)):
        place[columns[j]] = 1  # threads that write the same do not disturb each other
    near = np.flatnonzero(place)
    for i in range(len(near)):
        place[near[i]] = i
    for j in prange(len(columns)):
        columns[j] = place[columns[j]]
    return near
