"""2x2x2 pooling (SEMANTICS 4)."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ocnf_data.errors import OcnfError
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.resample import Halving


class Pooling(StrEnum):
    """What eight voxels become."""

    MAX = "max"
    """The largest value; its gradient goes to the first voxel that has it."""
    MEAN = "mean"


def grid_pool(x: OctreeBatch, kind: str = Pooling.MAX) -> OctreeBatch:
    """Half the resolution: 8 trees become 1, eight voxels one, wider leaves are copied at half their width.

    Raises:
        OcnfError: an unknown kind, or an axis of the grids that is not a multiple of 16.
    """
    if kind not in tuple(Pooling):
        raise OcnfError("no such pooling", where="grid_pool", field="kind", found=kind,
                        expected=" or ".join(Pooling))
    halving = x.structure.table(Halving.build, x.device)
    pool = _Max if kind == Pooling.MAX else _Mean
    return OctreeBatch(halving.structure, pool.apply(x.features, halving))


class _Max(torch.autograd.Function):
    """The backward pass asks of each leaf whether it won: a gather, and no scatter."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, halving: Halving) -> Tensor:
        pooled = features.index_select(0, halving.first)  # (L, C) -> (P, C)
        firsts = halving.first.index_select(0, halving.octets)  # (P,) -> (O,)
        largest = pooled.index_select(0, halving.octets)  # (O, C)
        winners = torch.zeros_like(largest, dtype=torch.uint8) if ctx.needs_input_grad[0] else None
        for slot in range(1, 8):
            candidate = features.index_select(0, firsts + slot)  # (O, C)
            if winners is not None:
                winners.masked_fill_(candidate > largest, slot)  # strictly: the first of equals stays
            largest = torch.maximum(largest, candidate)
        ctx.halving = halving
        if winners is not None:
            ctx.save_for_backward(winners)
        return pooled.index_copy_(0, halving.octets, largest)  # (P, C)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        halving: Halving = ctx.halving
        winners = torch.zeros_like(grad, dtype=torch.uint8)  # (P, C)
        winners.index_copy_(0, halving.octets, ctx.saved_tensors[0])  # rows O of P
        won = winners.index_select(0, halving.parents) == halving.slots  # (L, C) == (L, 1)
        return grad.index_select(0, halving.parents).mul_(won), None  # (P, C) -> (L, C)


class _Mean(torch.autograd.Function):
    """The mean, and its adjoint by a gather."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, halving: Halving) -> Tensor:
        pooled = features.index_select(0, halving.first)  # (L, C) -> (P, C)
        firsts = halving.first.index_select(0, halving.octets)  # (P,) -> (O,)
        total = pooled.index_select(0, halving.octets)  # (O, C)
        for slot in range(1, 8):
            total += features.index_select(0, firsts + slot)  # (O, C)
        ctx.halving = halving
        return pooled.index_copy_(0, halving.octets, total.mul_(0.125))  # (P, C)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        halving: Halving = ctx.halving
        return (grad * halving.shares.to(grad.dtype)).index_select(0, halving.parents), None
