"""Structures at half and at twice the resolution, and which leaf comes from which.

Pooling makes one tree of 2x2x2 trees: the root of each becomes a node of width 4, its nodes of width 4 become
nodes of width 2, and those of width 2 become voxels. Unpooling is the reverse: each octant of a tree becomes
a tree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ocnf_data.arrays import I32, U8, Prefix, TreeArray
from ocnf_data.errors import OcnfError
from ocnf_data.octree.bits import MAX_LEAVES, child_bits, is_split, leaf_of_voxel, tree_leaves, with_split
from ocnf_model.octree.leaves import tree_at, tree_place
from ocnf_model.octree.structure import Structure


@dataclass(frozen=True, eq=False)
class Halving:
    """A structure at half the resolution, and how its P leaves come from the L of the finer one.

    Attributes:
        structure: 8 trees became 1.
        first: (P,) int32, the leaf that each pooled leaf is, or the first of the eight voxels, which follow
            one another, that it holds.
        octets: (O,) int64, the pooled leaves that hold eight voxels.
        parents: (L,) int32, the pooled leaf of each leaf.
        slots: (L, 1) uint8, the place 0..7 of a leaf among the eight voxels; 0 for leaves that are copied.
        shares: (P, 1) float32, 1/8 for those of `octets`, else 1.
    """

    structure: Structure
    first: Tensor
    octets: Tensor
    parents: Tensor
    slots: Tensor
    shares: Tensor

    @classmethod
    def build(cls, fine: Structure) -> Halving:
        """Halve a structure.

        Raises:
            OcnfError: the grid has an odd number of trees along an axis.
        """
        if any(n % 2 for n in fine.grid):
            raise OcnfError("pooling needs an even number of trees along each axis", where="grid_pool",
                            found=f"{fine.shape} voxels", expected="multiples of 16")
        batch, (gd, gh, gw) = fine.batch_size, fine.grid
        structure = Structure(pooled_trees(fine.flat, fine.grid).reshape(batch, gd // 2, gh // 2, gw // 2, 2))
        first, parents, slots = match_pooled(fine.flat, fine.prefix, fine.grid, structure.flat,
                                             structure.prefix)
        is_octet = np.bincount(parents, minlength=structure.n_leaves) == 8  # (L,) -> (P,)
        return cls(structure, torch.from_numpy(first),
                   torch.from_numpy(np.flatnonzero(is_octet)), torch.from_numpy(parents),
                   torch.from_numpy(slots)[:, None],
                   torch.from_numpy(np.where(is_octet, 0.125, 1.0).astype(np.float32))[:, None])

    def to(self, device: torch.device) -> Halving:
        """The tables on a device; the structure stays where it is."""
        return Halving(self.structure, self.first.to(device), self.octets.to(device),
                       self.parents.to(device), self.slots.to(device), self.shares.to(device))


@dataclass(frozen=True, eq=False)
class Doubling:
    """A structure at twice the resolution: every leaf of twice the width, and those of 8 as 8 trees."""

    structure: Structure

    @classmethod
    def build(cls, coarse: Structure) -> Doubling:
        """Double a structure."""
        gd, gh, gw = coarse.grid
        trees = unpooled_trees(coarse.flat, coarse.grid)  # (T, 2) -> (8 T, 2)
        return cls(Structure(trees.reshape(coarse.batch_size, 2 * gd, 2 * gh, 2 * gw, 2)))

    def to(self, device: torch.device) -> Doubling:
        """This object itself: it holds no tensors."""
        return self


def doubled(coarse: Structure) -> Structure:
    """The structure at twice the resolution that `grid_unpool` makes."""
    return coarse.table(Doubling.build, torch.device("cpu")).structure


@njit(cache=True, nogil=True, parallel=True)
def pooled_trees(trees: TreeArray, grid: tuple[int, int, int]) -> TreeArray:
    """Trees (T / 8, 2) at half the resolution of (T, 2) trees in a grid."""
    coarse_grid = (grid[0] // 2, grid[1] // 2, grid[2] // 2)
    pooled = np.empty((len(trees) // 8, 2), np.uint64)  # (T / 8, 2)
    for t in prange(len(pooled)):
        b, gd, gh, gw = tree_place(t, coarse_grid)
        lo, hi = with_split(np.uint64(0), np.uint64(0), 0)
        for k in range(8):
            u = tree_at(b, 2 * gd + (k >> 2), 2 * gh + ((k >> 1) & 1), 2 * gw + (k & 1), grid)
            if not is_split(trees[u, 0], trees[u, 1], 0):
                continue
            lo, hi = with_split(lo, hi, 1 + k)
            for j in range(8):
                if is_split(trees[u, 0], trees[u, 1], 1 + j):
                    lo, hi = with_split(lo, hi, 8 * (1 + k) + 1 + j)
        pooled[t, 0], pooled[t, 1] = lo, hi
    return pooled


@njit(cache=True, nogil=True, parallel=True)
def match_pooled(
    trees: TreeArray, prefix: Prefix, grid: tuple[int, int, int], pooled: TreeArray, pooled_prefix: Prefix
) -> tuple[I32, I32, U8]:
    """`first`, `parents` and `slots` of `Halving`."""
    coarse_grid = (grid[0] // 2, grid[1] // 2, grid[2] // 2)
    first = np.empty(pooled_prefix[-1], np.int32)  # (P,)
    parents = np.empty(prefix[-1], np.int32)  # (L,)
    slots = np.empty(prefix[-1], np.uint8)  # (L,)
    for t in prange(len(trees)):
        b, gd, gh, gw = tree_place(t, grid)
        u = tree_at(b, gd // 2, gh // 2, gw // 2, coarse_grid)
        cells = np.empty((MAX_LEAVES, 4), np.int16)
        for cell in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            z, y, x = cells[cell, 0], cells[cell, 1], cells[cell, 2]
            found, _ = leaf_of_voxel(pooled[u, 0], pooled[u, 1], 4 * (gd % 2) + z // 2,
                                     4 * (gh % 2) + y // 2, 4 * (gw % 2) + x // 2)
            leaf, parent = prefix[t] + cell, pooled_prefix[u] + found
            slot = 4 * (z % 2) + 2 * (y % 2) + x % 2  # 0 for leaves wider than a voxel
            parents[leaf] = parent
            slots[leaf] = slot
            if slot == 0:
                first[parent] = leaf
    return first, parents, slots


@njit(cache=True, nogil=True, parallel=True)
def unpooled_trees(trees: TreeArray, grid: tuple[int, int, int]) -> TreeArray:
    """Trees (8 T, 2) at twice the resolution of (T, 2) trees in a grid."""
    fine_grid = (2 * grid[0], 2 * grid[1], 2 * grid[2])
    unpooled = np.zeros((8 * len(trees), 2), np.uint64)
    for t in prange(len(trees)):
        b, gd, gh, gw = tree_place(t, grid)
        for k in range(8):
            if not is_split(trees[t, 0], trees[t, 1], 1 + k):
                continue
            u = tree_at(b, 2 * gd + (k >> 2), 2 * gh + ((k >> 1) & 1), 2 * gw + (k & 1), fine_grid)
            unpooled[u, 0] = np.uint64(1) | child_bits(trees[t, 0], trees[t, 1], 1 + k) << np.uint64(1)
    return unpooled
