"""The trees of a batch of grid-octrees: immutable, shared by everything that lives on them.

Tables that depend on the trees alone (neighbours, overlap weights, pooling maps) are made when an operation
first asks for them and are kept with the structure, so that all layers on one structure share them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Protocol, Self, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from ocnf_data.arrays import I64, U8, TreeArray
from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_data.octree.bits import TREE_WIDTH, leaf_prefix
from ocnf_model.octree.leaves import leaf_sizes


class Movable(Protocol):
    """Tables of tensors that can be copied to a device."""

    def to(self, device: torch.device, /) -> Self:
        """The tables on a device."""


Tables = TypeVar("Tables", bound=Movable)


class Structure:
    """Trees of B grids of one size. Compared by identity; `equals` compares the trees.

    Attributes:
        trees: (B, GD, GH, GW, 2) uint64, as `GridOctree.trees`; valid, never changed.
    """

    def __init__(self, trees: TreeArray) -> None:
        self.trees = np.ascontiguousarray(trees)
        self._tables: dict[Any, Any] = {}
        self._relations: WeakKeyDictionary[Structure, dict[Any, Any]] = WeakKeyDictionary()

    @classmethod
    def of_grids(cls, grids: Sequence[GridOctree]) -> Structure:
        """The structure of octrees of one size.

        Raises:
            OcnfError: no octrees, or their sizes differ.
        """
        if not grids:
            raise OcnfError("a batch without octrees", code="empty", where="OctreeBatch", field="grids")
        for b, grid in enumerate(grids):
            if grid.shape != grids[0].shape:
                raise OcnfError("octrees of a batch differ in size", where="OctreeBatch",
                                field=f"grids[{b}]", found=grid.shape, expected=grids[0].shape)
        return cls(np.stack([grid.trees for grid in grids]))  # (B, GD, GH, GW, 2)

    @classmethod
    def full(cls, batch_size: int, shape: tuple[int, int, int]) -> Structure:
        """Every leaf a voxel, for `batch_size` grids of `shape` (D, H, W) voxels, multiples of 8."""
        trees = np.empty((batch_size, *(n // TREE_WIDTH for n in shape), 2), np.uint64)
        trees[..., 0] = np.uint64(2**64 - 1)
        trees[..., 1] = np.uint64(2**9 - 1)  # bits 64-72
        return cls(trees)

    @property
    def batch_size(self) -> int:
        """B, the number of grids."""
        return self.trees.shape[0]

    @property
    def grid(self) -> tuple[int, int, int]:
        """(GD, GH, GW): trees along each axis."""
        _, gd, gh, gw, _ = self.trees.shape
        return gd, gh, gw

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, H, W) in voxels."""
        gd, gh, gw = self.grid
        return TREE_WIDTH * gd, TREE_WIDTH * gh, TREE_WIDTH * gw

    @property
    def flat(self) -> TreeArray:
        """(T, 2): the trees of all grids, T = B * GD * GH * GW."""
        return self.trees.reshape(-1, 2)

    @cached_property
    def prefix(self) -> I64:
        """(T + 1,): index of each tree's first leaf in the batch, and the number of leaves L at the end."""
        return leaf_prefix(self.flat)

    @property
    def n_leaves(self) -> int:
        """L, leaves of all grids."""
        return int(self.prefix[-1])

    @cached_property
    def leaves_per_grid(self) -> list[int]:
        """Leaves of each grid; they sum to L."""
        bounds = self.prefix[:: len(self.flat) // self.batch_size]  # (B + 1,)
        return [int(n) for n in np.diff(bounds)]

    @cached_property
    def sizes(self) -> U8:
        """(L,) uint8: width of each leaf in voxels (8, 4, 2 or 1)."""
        return leaf_sizes(self.flat, self.prefix)

    def volumes(self, device: torch.device) -> Tensor:
        """(L, 1) float32 on a device: voxels of each leaf, 1 to 512."""
        return self.table(_leaf_volumes, device)

    def equals(self, other: Structure) -> bool:
        """Whether both are the same trees."""
        return self is other or np.array_equal(self.trees, other.trees)

    def check_same_grid(self, other: Structure, where: str) -> None:
        """Raise OcnfError unless both have the same number of grids of the same size."""
        if self.trees.shape != other.trees.shape:
            raise OcnfError("batches differ in size", where=where, found=other.describe(),
                            expected=self.describe())

    def union(self, other: Structure) -> Structure:
        """The coarsest structure at least as fine as both; one of the two where it already is."""
        self.check_same_grid(other, "union of structures")
        trees = self.trees | other.trees  # a node is split in either: its ancestors are too
        if np.array_equal(trees, self.trees):
            return self
        if np.array_equal(trees, other.trees):
            return other
        return Structure(trees)

    def table(self, build: Callable[[Structure], Tables], device: torch.device) -> Tables:
        """`build(self)` on a device, made at the first call and kept."""
        key = build, device
        if key not in self._tables:
            self._tables[key] = build(self).to(device)
        tables: Tables = self._tables[key]
        return tables

    def relation(
        self, build: Callable[[Structure, Structure], Tables], other: Structure, device: torch.device
    ) -> Tables:
        """`build(self, other)` on a device, made at the first call and kept while both structures live."""
        kept = self._relations.setdefault(other, {})
        key = build, device
        if key not in kept:
            kept[key] = build(self, other).to(device)
        tables: Tables = kept[key]
        return tables

    def describe(self) -> str:
        """Batch size and size, for messages."""
        return f"{self.batch_size} of {'x'.join(map(str, self.shape))}"

    def __repr__(self) -> str:
        """One line: size, leaves and their share of the voxels."""
        share = self.n_leaves / (self.batch_size * np.prod(self.shape))
        return f"Structure({self.describe()}, n_leaves={self.n_leaves} ({share:.1%}))"


def _leaf_volumes(structure: Structure) -> Tensor:
    return torch.from_numpy(structure.sizes.astype(np.float32) ** 3)[:, None]  # (L, 1)
