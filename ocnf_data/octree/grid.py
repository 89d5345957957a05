"""GridOctree: a volume as a grid of shallow octrees, each over 8^3 voxels (SEMANTICS 3)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import F32, I32, I64, U8, TreeArray
from ocnf_data.errors import OcnfError
from ocnf_data.octree import dense
from ocnf_data.octree.bits import TREE_WIDTH, leaf_prefix
from ocnf_data.octree.oc import read_oc, write_oc

MAX_RESOLUTION = 1024
"""Most voxels along an axis of a volume that is fused or stored."""


@dataclass(frozen=True, eq=False)
class GridOctree:
    """A piecewise-constant volume, stored as trees and the values of their leaves. Never changed in place.

    Attributes:
        trees: (GD, GH, GW, 2) uint64, C-contiguous: the 128 bits of each tree, bit i of a tree is
            `(trees[..., i // 64] >> (i % 64)) & 1`, 1 = split; bits 73.. are 0 (see `octree.bits`). On a
            little-endian machine `trees.view(uint8)[..., :10]` are the 10 bytes a tree of the format.
        data: (n_leaves, C) float32, finite: one row a leaf, trees in (gd, gh, gw) C order, inside a tree
            breadth first (width 8, 4, 2, 1), each width in bit order.

    Raises:
        OcnfError: the arrays have other dtypes or shapes, some bits are no tree, the number of rows is not
            the number of leaves, or a value is not finite.
    """

    trees: TreeArray
    data: F32

    def __post_init__(self) -> None:
        """Check everything, so that an octree that exists is valid."""
        object.__setattr__(self, "trees", check_trees(self.trees))
        object.__setattr__(self, "data", _check_data(self.data, self.n_leaves))

    @classmethod
    def trusted(cls, trees: TreeArray, data: F32) -> GridOctree:
        """Wrap arrays that are valid by construction, unchecked: for the outputs of kernels only."""
        octree = object.__new__(cls)
        object.__setattr__(octree, "trees", trees)
        object.__setattr__(octree, "data", data)
        return octree

    @classmethod
    def from_dense(cls, values: F32, tolerance: float | None = None) -> GridOctree:
        """Top down over nodes of 8, 4 and 2 voxels: split where some channel's max - min exceeds `tolerance`.

        Args:
            values: (C, D, H, W) float32, finite; D, H, W multiples of 8.
            tolerance: absolute, in the units of the values; None = 1e-6 times max - min of the whole volume.

        Returns:
            The octree whose leaves hold the means (accumulated in float64) of their voxels.

        Raises:
            OcnfError: wrong dtype or shape, a value that is not finite, a negative tolerance.
        """
        values = _check_volume(values)
        low, high = _extremes(values)
        if tolerance is None:
            tolerance = 1e-6 * (float(high.max()) - float(low.min()))
        trees = dense.split_trees(values, low, high, _check_tolerance(tolerance))
        data = dense.mean_leaves(values, low, high, trees, leaf_prefix(trees))
        return cls.trusted(trees.reshape(*_grid_of(values), 2), data)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, H, W) in voxels."""
        gd, gh, gw, _ = self.trees.shape
        return gd * TREE_WIDTH, gh * TREE_WIDTH, gw * TREE_WIDTH

    @property
    def channels(self) -> int:
        """C, values a leaf."""
        return self.data.shape[1]

    @property
    def n_leaves(self) -> int:
        """Leaves of all trees."""
        return int(self.prefix[-1])

    @cached_property
    def prefix(self) -> I64:
        """(T + 1,): index of each tree's first leaf, and the number of leaves at the end."""
        return leaf_prefix(self.trees.reshape(-1, 2))

    def to_dense(self) -> F32:
        """(C, D, H, W) float32: every voxel holds the value of its leaf."""
        volume = np.empty((self.channels, *self.shape), np.float32)
        dense.paint(self.trees.reshape(-1, 2), self.prefix, self.data, volume)
        return volume

    def leaf_width(self) -> U8:
        """(D, H, W) uint8: width in voxels (8, 4, 2 or 1) of the leaf that holds each voxel."""
        volume = np.empty((1, *self.shape), np.uint8)
        dense.paint(self.trees.reshape(-1, 2), self.prefix, self.leaf_sizes()[:, None], volume)
        return volume[0]

    def leaf_positions(self) -> I32:
        """(n_leaves, 3) int32: lowest voxel (z, y, x) of each leaf."""
        return self._located[0]

    def leaf_sizes(self) -> U8:
        """(n_leaves,) uint8: width of each leaf in voxels (8, 4, 2 or 1)."""
        return self._located[1]

    @property
    def _located(self) -> tuple[I32, U8]:
        _, gh, gw, _ = self.trees.shape
        return dense.locate_leaves(self.trees.reshape(-1, 2), self.prefix, gh, gw)

    def gather(self, zyx: npt.ArrayLike) -> F32:
        """Values at voxels, without a dense volume.

        Args:
            zyx: (N, 3) integers, (z, y, x) inside the volume.

        Returns:
            (N, C) float32.

        Raises:
            OcnfError: `zyx` is not integers (N, 3), or a voxel lies outside the volume.
        """
        voxels = np.asarray(zyx)
        if voxels.ndim != 2 or voxels.shape[1] != 3 or voxels.dtype.kind not in "iu":
            raise OcnfError("not voxel indices", field="zyx", found=f"{voxels.dtype} {voxels.shape}",
                            expected="integers (N, 3)")
        if voxels.size and (voxels.min() < 0 or (voxels.max(axis=0) >= self.shape).any()):
            raise OcnfError("a voxel lies outside the volume", field="zyx", expected=f"within {self.shape}",
                            found=f"{voxels.min(axis=0)} to {voxels.max(axis=0)}")
        _, gh, gw, _ = self.trees.shape
        flat = self.trees.reshape(-1, 2)
        return self.data[dense.leaves_at(flat, self.prefix, gh, gw, voxels.astype(np.int64))]

    def with_data(self, data: F32) -> GridOctree:
        """An octree of the same trees with other values, (n_leaves, any C) float32."""
        return self.trusted(self.trees, _check_data(data, self.n_leaves))

    def write_oc(self, path: str | os.PathLike[str]) -> None:
        """Write the published `.oc` format (see `octree.oc`)."""
        write_oc(self, path)

    @staticmethod
    def read_oc(path: str | os.PathLike[str]) -> GridOctree:
        """Read a `.oc` file (see `octree.oc`)."""
        return read_oc(path, GridOctree)

    def __repr__(self) -> str:
        """One line: size, channels, leaves and their share of the voxels."""
        share = self.n_leaves / np.prod(self.shape)
        return f"GridOctree({'x'.join(map(str, self.shape))}, channels={self.channels}, " \
               f"n_leaves={self.n_leaves} ({share:.1%}))"


def mean_on(trees: TreeArray, values: F32) -> F32:
    """Means of a (C, D, H, W) float32 volume over the leaves of given trees: (n_leaves, C) float32.

    Raises:
        OcnfError: `trees` are no trees, `values` is no such volume or not finite, or they differ in size.
    """
    trees, values = check_trees(trees), _check_volume(values)
    if trees.shape[:3] != _grid_of(values):
        raise OcnfError("trees and volume differ in size", field="values", found=values.shape[1:],
                        expected=tuple(TREE_WIDTH * n for n in trees.shape[:3]))
    flat = trees.reshape(-1, 2)
    return dense.mean_leaves(values, *_extremes(values), flat, leaf_prefix(flat))


def check_trees(trees: TreeArray) -> TreeArray:
    """The trees, C-contiguous, if they are (GD, GH, GW, 2) uint64 whose bits are trees; else OcnfError."""
    if not _is_array(trees, np.uint64, ndim=4) or trees.shape[3] != 2:
        raise OcnfError("not a grid of trees", field="trees", found=_describe(trees),
                        expected="uint64 (GD, GH, GW, 2)")
    if trees.size == 0:
        raise OcnfError("an empty grid", field="trees", found=trees.shape, expected="at least one tree")
    trees = np.ascontiguousarray(trees)
    bad = dense.first_bad_tree(trees.reshape(-1, 2))
    if bad >= 0:
        place = [int(i) for i in np.unravel_index(bad, trees.shape[:3])]
        raise OcnfError("the bits are no tree: a node below an unsplit one is split, or an unused bit is set",
                        code="structure", field=f"trees{place}",
                        found=" ".join(f"{int(word):#x}" for word in trees.reshape(-1, 2)[bad]))
    return trees


def _check_data(data: F32, n_leaves: int) -> F32:
    if not _is_array(data, np.float32, ndim=2) or data.shape[1] < 1:
        raise OcnfError("not leaf values", field="data", found=_describe(data),
                        expected="float32 (n_leaves, C)")
    if len(data) != n_leaves:
        raise OcnfError("the trees have another number of leaves", code="structure", field="data",
                        found=f"{len(data)} rows", expected=f"{n_leaves} leaves")
    data = np.ascontiguousarray(data)
    if not dense.all_finite(data.reshape(-1).view(np.uint32)):
        raise OcnfError("a value is not finite", code="non_finite", field="data")
    return data


def _check_volume(values: F32) -> F32:
    if not _is_array(values, np.float32, ndim=4) or values.size == 0:
        raise OcnfError("not a volume", field="values", found=_describe(values),
                        expected="float32 (C, D, H, W)")
    if any(n % TREE_WIDTH for n in values.shape[1:]):
        raise OcnfError("an axis of the volume is not a multiple of 8", field="values",
                        found=values.shape[1:])
    return np.ascontiguousarray(values)


def _check_tolerance(tolerance: float) -> float:
    if not tolerance >= 0:  # NaN is refused too
        raise OcnfError("not a tolerance", field="tolerance", found=tolerance, expected="0 or more")
    return float(tolerance)


def _extremes(values: F32) -> tuple[F32, F32]:
    low, high, finite = dense.tree_extremes(values)
    if not finite:
        raise OcnfError("a value is not finite", code="non_finite", field="values")
    return low, high


def _grid_of(values: F32) -> tuple[int, int, int]:
    _, depth, height, width = values.shape
    return depth // TREE_WIDTH, height // TREE_WIDTH, width // TREE_WIDTH


def _is_array(value: object, dtype: npt.DTypeLike, ndim: int) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == dtype and value.ndim == ndim


def _describe(value: object) -> str:
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
