"""Channels of two batches, side by side."""

from __future__ import annotations

import torch

from ocnf_data.errors import OcnfError
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.leafmap import leaf_means


def concat(a: OctreeBatch, b: OctreeBatch) -> OctreeBatch:
    """The channels of `a`, then those of `b`, on the structure of `a`; differentiable.

    Where the structures differ, a leaf of `a` takes the mean of `b` over its voxels.

    Raises:
        OcnfError: the batches differ in size, dtype or device.
    """
    return a.with_features(torch.cat([a.features, on_structure_of(a, b, "concat")], dim=1))  # (L, Ca + Cb)


def on_structure_of(a: OctreeBatch, b: OctreeBatch, where: str) -> torch.Tensor:
    """Features (L of a, C of b): the means of `b` over the leaves of `a`.

    Raises:
        OcnfError: the batches differ in size, dtype or device.
    """
    a.structure.check_same_grid(b.structure, where)
    if (a.features.dtype, a.device) != (b.features.dtype, b.device):
        raise OcnfError("the operands differ in dtype or device", where=where,
                        found=f"{b.features.dtype} on {b.device}",
                        expected=f"{a.features.dtype} on {a.device}")
    if a.structure.equals(b.structure):
        return b.features
    return b.structure.relation(leaf_means, a.structure, a.device)(b.features)  # (L of b, C) -> (L of a, C)
