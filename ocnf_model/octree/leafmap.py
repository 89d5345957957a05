"""Linear maps between the leaves of two structures, as sparse matrices, with their exact adjoints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from ocnf_data.errors import OcnfError
from ocnf_model.octree.leaves import (
    count_overlaps,
    fill_overlaps,
    leaf_voxels,
    parent_leaves,
    transpose,
    voxel_leaves,
)
from ocnf_model.octree.structure import Structure


@dataclass(frozen=True, eq=False)
class LeafMap:
    """y[i] = sum over j of weight[j] * x[column[j]], j from starts[i] to starts[i + 1].

    Calling it on (n_columns, C) features gives (n_rows, C), differentiable; float16 and bfloat16 are summed
    in float32.

    Attributes:
        n_columns: rows of x.
        columns: (N,) int32.
        starts: (n_rows + 1,) int32; None = one entry a row.
        weights: (N,) float32; None = all 1.
    """

    n_columns: int
    columns: Tensor
    starts: Tensor | None = None
    weights: Tensor | None = None

    def __call__(self, features: Tensor) -> Tensor:
        """Apply to (n_columns, C) features."""
        if not (torch.is_grad_enabled() and features.requires_grad):
            return self.product(features)
        result: Tensor = _Product.apply(features, self)
        return result

    def product(self, features: Tensor) -> Tensor:
        """Apply without a gradient."""
        if self.starts is None:
            return features.index_select(0, self.columns)  # (n_columns, C) -> (n_rows, C)
        return sparse_product(self.starts, self.columns, self.weights, features)

    @cached_property
    def adjoint(self) -> LeafMap:
        """The transposed matrix."""
        columns = self.columns.cpu().numpy()
        starts = np.arange(len(columns) + 1) if self.starts is None else self.starts.cpu().numpy()
        column_starts, rows, places = transpose(columns, starts.astype(np.int64), self.n_columns)
        device = self.columns.device
        is_permutation = self.starts is None and bool((np.diff(column_starts) == 1).all())
        return LeafMap(
            n_columns=len(starts) - 1,
            columns=torch.from_numpy(rows).to(device),
            starts=None if is_permutation else torch.from_numpy(column_starts.astype(np.int32)).to(device),
            weights=None if self.weights is None else self.weights[torch.from_numpy(places).to(device)],
        )

    def to(self, device: torch.device) -> LeafMap:
        """The map on a device."""
        return replace(
            self,
            columns=self.columns.to(device),
            starts=None if self.starts is None else self.starts.to(device),
            weights=None if self.weights is None else self.weights.to(device),
        )


def sparse_product(starts: Tensor, columns: Tensor, weights: Tensor | None, features: Tensor) -> Tensor:
    """Rows of a sparse matrix times (n_columns, C) features; without a gradient."""
    if not len(columns):
        return features.new_zeros(len(starts) - 1, features.shape[1])
    values = features.float() if features.element_size() < 4 else features
    product = embedding_bag(columns, values, starts, mode="sum", include_last_offset=True,
                            per_sample_weights=None if weights is None else weights.to(values.dtype))
    return product.to(features.dtype)


class _Product(torch.autograd.Function):
    """A LeafMap and its adjoint."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, leaf_map: LeafMap) -> Tensor:
        ctx.leaf_map = leaf_map
        return leaf_map.product(features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return ctx.leaf_map.adjoint(grad.contiguous()), None


def voxels_from_leaves(structure: Structure) -> LeafMap:
    """Leaves to voxels, in (b, z, y, x) C order: for small volumes."""
    columns = voxel_leaves(structure.flat, structure.prefix, structure.grid)  # (B D H W,)
    return LeafMap(structure.n_leaves, torch.from_numpy(columns))


def leaves_from_voxels(structure: Structure) -> LeafMap:
    """Voxels, in (b, z, y, x) C order, to the leaves of a structure whose leaves are all voxels."""
    columns = leaf_voxels(structure.flat, structure.prefix, structure.grid)  # (L,)
    return LeafMap(structure.n_leaves, torch.from_numpy(columns))


def refinement(coarse: Structure, fine: Structure) -> LeafMap:
    """Leaves to those of a structure at least as fine: each takes the value of the leaf that holds it.

    The fine structure has the resolution of the coarse one, or twice that.

    Raises:
        OcnfError: it is not as fine, or the sizes do not fit.
    """
    shift = int(fine.grid != coarse.grid)
    if fine.batch_size != coarse.batch_size or fine.grid != tuple(n << shift for n in coarse.grid):
        raise OcnfError("sizes do not fit", field="guide", found=fine.describe(),
                        expected=f"that of {coarse.describe()}, or twice it")
    columns = parent_leaves(fine.flat, fine.prefix, coarse.flat, coarse.prefix, fine.grid, shift)  # (L fine,)
    if columns.min() < 0:
        raise OcnfError("the guide is coarser than the features somewhere", field="guide",
                        fix="take the union of both structures")
    return LeafMap(coarse.n_leaves, torch.from_numpy(columns))


def leaf_means(source: Structure, target: Structure) -> LeafMap:
    """Leaves to those of any structure of the same size: the mean over each target leaf.

    Raises:
        OcnfError: the sizes differ.
    """
    target.check_same_grid(source, "leaf means")
    counts = count_overlaps(target.flat, target.prefix, source.flat)  # (L target,)
    starts = np.concatenate([[0], np.cumsum(counts)])  # (L target + 1,)
    columns, weights = fill_overlaps(target.flat, target.prefix, source.flat, source.prefix, starts)  # (N,)
    if len(columns) == target.n_leaves:
        return LeafMap(source.n_leaves, torch.from_numpy(columns))
    return LeafMap(source.n_leaves, torch.from_numpy(columns), torch.from_numpy(starts.astype(np.int32)),
                   torch.from_numpy(weights))
