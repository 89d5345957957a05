"""OctreeBatch: features on the leaves of a batch of grid-octrees, as one tensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_data.octree.bits import TREE_WIDTH
from ocnf_model.octree.leafmap import LeafMap, leaves_from_voxels, refinement, voxels_from_leaves
from ocnf_model.octree.structure import Structure


@dataclass(frozen=True, eq=False)
class OctreeBatch:
    """B piecewise-constant volumes of C channels on grid-octrees of one size, with different structures.

    >>> from ocnf_model import OctreeConv3d
    >>> empty = GridOctree.from_dense(np.zeros((10, 32, 32, 32), np.float32))     # 4^3 trees of one leaf
    >>> batch = OctreeBatch.from_grids([empty, empty])
    >>> batch.features.shape                                      # leaves of the first, then of the second
    torch.Size([128, 10])
    >>> OctreeConv3d(10, 16)(batch).to_dense().shape
    torch.Size([2, 16, 32, 32, 32])

    Attributes:
        structure: the trees; shared with other batches.
        features: (L, C) floating point, one row a leaf: grids in order, leaves in `GridOctree` order.

    Raises:
        OcnfError: the features are not (L, C) floating point.
    """

    structure: Structure
    features: Tensor

    def __post_init__(self) -> None:
        """Check that there is a row for each leaf."""
        features = self.features
        if not isinstance(features, Tensor) or features.ndim != 2 or not features.is_floating_point():
            raise OcnfError("not features", where="OctreeBatch", field="features", found=_describe(features),
                            expected="a floating point tensor (L, C)")
        if len(features) != self.structure.n_leaves:
            raise OcnfError("the structure has another number of leaves", where="OctreeBatch",
                            field="features", found=f"{len(features)} rows",
                            expected=f"{self.structure.n_leaves} leaves")

    @classmethod
    def from_grids(cls, grids: Sequence[GridOctree]) -> OctreeBatch:
        """Octrees of one size and number of channels, as float32 on the CPU.

        Raises:
            OcnfError: there are none (`empty`), or they differ in size or channels.
        """
        structure = Structure.of_grids(grids)
        for b, grid in enumerate(grids):
            if grid.channels != grids[0].channels:
                raise OcnfError("octrees of a batch differ in channels", where="OctreeBatch",
                                field=f"grids[{b}]", found=grid.channels, expected=grids[0].channels)
        return cls(structure, torch.from_numpy(np.concatenate([grid.data for grid in grids])))

    @classmethod
    def full(cls, dense: Tensor) -> OctreeBatch:
        """(B, C, D, H, W) floating point, D, H, W multiples of 8: every leaf a voxel; differentiable.

        Raises:
            OcnfError: `dense` is something else.
        """
        if not isinstance(dense, Tensor) or dense.ndim != 5 or not dense.is_floating_point() \
                or any(n % TREE_WIDTH or not n for n in dense.shape[2:]):
            raise OcnfError("not a batch of volumes", where="OctreeBatch.full", field="dense",
                            found=_describe(dense),
                            expected="floating point (B, C, D, H, W), D, H, W multiples of 8")
        depth, height, width = dense.shape[2:]
        structure = Structure.full(dense.shape[0], (depth, height, width))
        voxels = dense.permute(0, 2, 3, 4, 1).reshape(-1, dense.shape[1])  # (B D H W, C)
        return cls(structure, structure.table(leaves_from_voxels, dense.device)(voxels))

    def to_grids(self) -> list[GridOctree]:
        """One `GridOctree` a sample, float32.

        Raises:
            OcnfError: a feature is not finite.
        """
        data = self.features.detach().to("cpu", torch.float32)  # (L, C)
        parts = data.split(self.structure.leaves_per_grid)
        return [GridOctree(trees, np.ascontiguousarray(part.numpy()))
                for trees, part in zip(self.structure.trees, parts, strict=True)]

    def to_dense(self) -> Tensor:
        """(B, C, D, H, W): every voxel holds the features of its leaf; differentiable. For small volumes."""
        voxels = voxels_from_leaves(self.structure).to(self.features.device)(self.features)
        shape = self.batch_size, *self.structure.shape, self.channels
        return voxels.view(shape).permute(0, 4, 1, 2, 3)  # (B, D, H, W, C) -> (B, C, D, H, W)

    def with_features(self, features: Tensor) -> OctreeBatch:
        """A batch of the same structure with other features, (L, any C)."""
        return OctreeBatch(self.structure, features)

    def refined(self, structure: Structure) -> OctreeBatch:
        """These volumes on a structure at least as fine, of the same resolution or twice that."""
        if structure.equals(self.structure):
            return self.with_features(self.features)
        return OctreeBatch(structure, self.map_to(structure)(self.features))

    def map_to(self, structure: Structure) -> LeafMap:
        """The linear map of `refined`."""
        return self.structure.relation(refinement, structure, self.features.device)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> OctreeBatch:
        """The batch with its features on a device and of a dtype."""
        return self.with_features(self.features.to(device=device, dtype=dtype))

    @property
    def batch_size(self) -> int:
        """B, the number of grids."""
        return self.structure.batch_size

    @property
    def channels(self) -> int:
        """C, features a leaf."""
        return self.features.shape[1]

    @property
    def n_leaves(self) -> int:
        """L, leaves of all grids."""
        return self.structure.n_leaves

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, H, W) of each grid, in voxels."""
        return self.structure.shape

    @property
    def device(self) -> torch.device:
        """Device of the features."""
        return self.features.device

    def __repr__(self) -> str:
        """One line: size, channels, leaves, dtype and device."""
        return f"OctreeBatch({self.structure.describe()}, channels={self.channels}, n_leaves=" \
               f"{self.n_leaves}, {self.features.dtype} on {self.device})"


def _describe(value: object) -> str:
    return f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
