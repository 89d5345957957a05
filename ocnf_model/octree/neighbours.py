"""What a 3x3x3 convolution reads: which leaves, and with what weight.

For a leaf c and an offset k = 9 kz + 3 ky + kx (k - 1 = -1, 0, 1 along each axis), row (c, k) of the overlap
matrix holds, for each leaf l, the fraction of the voxels v of c for which v + k - 1 lies in l. Voxels outside
the grid count for nothing. Rows of *regular* leaves, one voxel wide and not at the border of their grid, have
a single entry of 1 each: they are kept as a plain index table, all others as sparse rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ocnf_data.arrays import F32, I16, I32, I64, Bool, Prefix, TreeArray
from ocnf_data.octree.bits import MAX_LEAVES, is_split, leaf_of_voxel, tree_leaves
from ocnf_model.octree.leaves import tree_at, tree_place
from ocnf_model.octree.structure import Structure

N_OFFSETS = 27
HALO = 10  # a tree and one voxel around it
Corner: TypeAlias = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The overlap matrix of a structure.

    Attributes:
        regular: (R,) int64, the regular leaves in order.
        table: (R, 27) int32, for each of them the leaf at each offset.
        irregular: (I,) int64, all other leaves.
        starts: (27 I + 1,) int32, row (i, k) has the entries starts[27 i + k] to starts[27 i + k + 1].
        columns, weights: (N,) int32 and float32, the leaf and the fraction of each entry.
    """

    regular: Tensor
    table: Tensor
    irregular: Tensor
    starts: Tensor
    columns: Tensor
    weights: Tensor

    @classmethod
    def build(cls, structure: Structure) -> Neighbours:
        """Compute the matrix on the CPU."""
        trees, prefix, grid = structure.flat, structure.prefix, structure.grid
        regular = regular_leaves(trees, prefix, grid)  # (L,) bool
        rank = np.cumsum(regular, dtype=np.int64) - regular  # regular leaves in front of each leaf
        n_regular = int(regular.sum())
        starts = np.zeros(N_OFFSETS * (structure.n_leaves - n_regular) + 1, np.int64)  # (27 I + 1,)
        count_irregular(trees, prefix, grid, regular, rank, starts[1:])
        np.cumsum(starts, out=starts)
        table, columns, weights = fill(trees, prefix, grid, regular, rank, n_regular, starts)
        return cls(
            regular=torch.from_numpy(np.flatnonzero(regular)),
            table=torch.from_numpy(table),
            irregular=torch.from_numpy(np.flatnonzero(~regular)),
            starts=torch.from_numpy(starts.astype(np.int32)),
            columns=torch.from_numpy(columns),
            weights=torch.from_numpy(weights),
        )

    def to(self, device: torch.device) -> Neighbours:
        """The tables on a device."""
        return Neighbours(**{name: tensor.to(device) for name, tensor in vars(self).items()})


@njit(cache=True, nogil=True, parallel=True)
def regular_leaves(trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int]) -> Bool:
    """(L,) bool: leaves one voxel wide whose 27 neighbours all lie inside the grid."""
    regular = np.empty(prefix[-1], np.bool_)  # (L,)
    for t in prange(len(trees)):
        _, gd, gh, gw = tree_place(t, grid)
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        for leaf in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            z, y, x = 8 * gd + cells[leaf, 0], 8 * gh + cells[leaf, 1], 8 * gw + cells[leaf, 2]
            inside = 0 < z < 8 * grid[0] - 1 and 0 < y < 8 * grid[1] - 1 and 0 < x < 8 * grid[2] - 1
            regular[prefix[t] + leaf] = inside and cells[leaf, 3] == 1
    return regular


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
def count_irregular(
    trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], regular: Bool,
    rank: I64, counts: I64,
) -> None:
    """Add the number of entries of each row (i, k) of the irregular leaves to `counts` (27 I,)."""
    for t in prange(len(trees)):
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        n = tree_leaves(trees[t, 0], trees[t, 1], cells)
        leaves, widths = np.empty((HALO, HALO, HALO), np.int32), np.empty((HALO, HALO, HALO), np.int32)
        found = np.empty((HALO**3, 10), np.int32)  # (1000, 10)
        if n > 1:
            _paint_halo(trees, prefix, grid, t, leaves, widths)
        for cell in range(n):
            leaf = prefix[t] + cell
            if regular[leaf]:
                continue
            row = N_OFFSETS * (leaf - rank[leaf])
            n_found = _around_leaf(cells[cell], leaves, widths, found) if n > 1 \
                else _around_tree(trees, prefix, grid, t, found)
            for m in range(n_found):
                for kz in range(3):
                    for ky in range(3):
                        if found[m, 1 + kz] * found[m, 4 + ky] > 0:
                            for kx in range(3):
                                counts[row + 9 * kz + 3 * ky + kx] += found[m, 7 + kx] > 0


@njit(cache=True, nogil=True, parallel=True)
def fill(
    trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], regular: Bool,
    rank: I64, n_regular: int, starts: I64,
) -> tuple[I32, I32, F32]:
    """The table of the regular leaves, and columns and weights of the others, as in `Neighbours`."""
    table = np.empty((n_regular, N_OFFSETS), np.int32)  # (R, 27)
    columns = np.empty(starts[-1], np.int32)  # (N,)
    weights = np.empty(starts[-1], np.float32)  # (N,)
    for t in prange(len(trees)):
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        n = tree_leaves(trees[t, 0], trees[t, 1], cells)
        leaves, widths = np.empty((HALO, HALO, HALO), np.int32), np.empty((HALO, HALO, HALO), np.int32)
        found = np.empty((HALO**3, 10), np.int32)  # (1000, 10)
        if n > 1:
            _paint_halo(trees, prefix, grid, t, leaves, widths)
        for cell in range(n):
            leaf = prefix[t] + cell
            z, y, x, w = cells[cell, 0], cells[cell, 1], cells[cell, 2], cells[cell, 3]
            if regular[leaf]:
                row = table[rank[leaf]]
                for k in range(N_OFFSETS):
                    row[k] = leaves[z + k // 9, y + k // 3 % 3, x + k % 3]
                continue
            n_found = _around_leaf(cells[cell], leaves, widths, found) if n > 1 \
                else _around_tree(trees, prefix, grid, t, found)
            first = N_OFFSETS * (leaf - rank[leaf])
            cursor = starts[first : first + N_OFFSETS].copy()  # (27,)
            for m in range(n_found):
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
    return table, columns, weights
