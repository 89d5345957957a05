"""The 48 symmetries of the cube, acting exactly on octrees: structure and leaves move, no value changes.

A symmetry permutes the axes of a volume, then flips some of them; on a dense (D, H, W) volume it is

    np.flip(np.transpose(volume, axes), [j for j in range(3) if flips[j]])

Half of them are rotations, the others mirror. A volume that is no cube changes its shape with its axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from numba import njit

from ocnf_data.arrays import I64, Bool, Prefix, TreeArray
from ocnf_data.octree.bits import child_bits, is_split, leaf_prefix, popcount, splits_below, with_split
from ocnf_data.octree.grid import GridOctree
from ocnf_data.octree.stored import RawOctree

AnyOctree = TypeVar("AnyOctree", GridOctree, RawOctree)


@dataclass(frozen=True)
class Symmetry:
    """One symmetry: axis j of the result is axis `axes[j]` of the operand, reversed if `flips[j]`."""

    axes: tuple[int, int, int]
    flips: tuple[bool, bool, bool]

    @property
    def is_rotation(self) -> bool:
        """Whether it keeps the handedness: the parity of the permutation is that of the number of flips."""
        inversions = sum(self.axes[i] > self.axes[j] for i in range(3) for j in range(i + 1, 3))
        return (inversions + sum(self.flips)) % 2 == 0

    def __call__(self, octree: AnyOctree) -> AnyOctree:
        """The octree moved: `to_dense()` of the result is the symmetry of `to_dense()`."""
        octants = np.array([self._source_octant(k) for k in range(8)], np.int64)
        values = octree.data.view(f"u{octree.data.dtype.itemsize}")  # numba knows no float16; bits are moved
        trees, moved = _move(octree.trees, leaf_prefix(octree.trees.reshape(-1, 2)), values,
                             np.array(self.axes), np.array(self.flips), octants)
        data = moved.view(octree.data.dtype)
        if isinstance(octree, RawOctree):
            return RawOctree.trusted(trees, data, octree.kind)
        return GridOctree.trusted(trees, data)

    def _source_octant(self, k: int) -> int:
        """The child of the operand's node that becomes child `k` (4 dz + 2 dy + dx) of the result's."""
        halves = (k >> 2, k >> 1 & 1, k & 1)
        return sum((half != flip) << (2 - axis)
                   for half, flip, axis in zip(halves, self.flips, self.axes, strict=True))


SYMMETRIES: tuple[Symmetry, ...] = tuple(
    Symmetry(axes, flips)  # type: ignore[arg-type]
    for axes in permutations(range(3))
    for flips in product((False, True), repeat=3)
)
"""All 48; the first is the identity."""

ROTATIONS: tuple[Symmetry, ...] = tuple(symmetry for symmetry in SYMMETRIES if symmetry.is_rotation)
"""The 24 that are rotations; the first is the identity."""


@njit(cache=True, nogil=True)
def _move(
    trees: TreeArray,
    prefix: Prefix,
    data: npt.NDArray[Any],
    axes: I64,
    flips: Bool,
    octants: I64,
) -> tuple[TreeArray, npt.NDArray[Any]]:
    # Not parallel: loader workers are forked, and an OpenMP runtime does not survive a fork.
    size = np.array(trees.shape[:3])
    gd, gh, gw = size[axes[0]], size[axes[1]], size[axes[2]]
    moved_trees = np.empty((gd, gh, gw, 2), np.uint64)
    moved = np.empty_like(data)
    source = np.empty(3, np.int64)
    n = 0
    for d in range(gd):
        for h in range(gh):
            for w in range(gw):
                source[axes[0]] = gd - 1 - d if flips[0] else d
                source[axes[1]] = gh - 1 - h if flips[1] else h
                source[axes[2]] = gw - 1 - w if flips[2] else w
                t = (source[0] * size[1] + source[1]) * size[2] + source[2]
                lo, hi = trees[source[0], source[1], source[2]]
                leaves = data[prefix[t] : prefix[t + 1]]
                bits = _move_tree(lo, hi, leaves, octants, moved[n : n + len(leaves)])
                moved_trees[d, h, w, 0], moved_trees[d, h, w, 1] = bits
                n += len(leaves)
    return moved_trees, moved


@njit(cache=True, nogil=True)
def _move_tree(
    lo: np.uint64, hi: np.uint64, leaves: npt.NDArray[Any], octants: I64,
    moved: npt.NDArray[Any],
) -> tuple[np.uint64, np.uint64]:
    """Permute the leaves of one tree into `moved`; returns its new bits."""
    new_lo, new_hi = np.uint64(0), np.uint64(0)
    if not is_split(lo, hi, 0):
        moved[0] = leaves[0]
        return new_lo, new_hi
    new_lo, new_hi = with_split(new_lo, new_hi, 0)
    n_split = popcount(child_bits(lo, hi, 0))
    first2 = 8 - n_split  # where the leaves of width 2 and 1 begin, before and after
    first1 = first2 + 8 * n_split - (popcount(lo) + popcount(hi) - 1 - n_split)
    n4, n2, n1 = 0, first2, first1
    for new_k in range(8):
        k = octants[new_k]
        splits4 = splits_below(lo, hi, 1 + k) - 1  # split nodes of width 4 in front of this one
        if not is_split(lo, hi, 1 + k):
            _copy_row(leaves, k - splits4, moved, n4)
            n4 += 1
            continue
        new_lo, new_hi = with_split(new_lo, new_hi, 1 + new_k)
        for new_c in range(8):
            c = octants[new_c]
            node = 8 * (1 + k) + 1 + c
            splits2 = splits_below(lo, hi, node) - 1 - n_split  # the same for width 2
            if not is_split(lo, hi, node):
                _copy_row(leaves, first2 + 8 * splits4 + c - splits2, moved, n2)
                n2 += 1
                continue
            new_lo, new_hi = with_split(new_lo, new_hi, 8 * (1 + new_k) + 1 + new_c)
            for new_v in range(8):
                _copy_row(leaves, first1 + 8 * splits2 + octants[new_v], moved, n1)
                n1 += 1
    return new_lo, new_hi


@njit(cache=True, nogil=True)
def _copy_row(source: npt.NDArray[Any], i: int, target: npt.NDArray[Any], j: int) -> None:
    for c in range(source.shape[1]):
        target[j, c] = source[i, c]
