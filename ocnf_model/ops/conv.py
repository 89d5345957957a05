"""3x3x3 convolution on grid-octrees, and its exact adjoint (SEMANTICS 4).

With A_k the (L, L) overlap matrix of offset k (see `neighbours`), x (L, C_in), W_k (C_in, C_out) and
D = diag(voxels of each leaf):

    y = b + sum_k A_k x W_k
    A_k^T = D A_{-k} D^-1,  so with  h_k = A_{-k} (D^-1 dy)
    dx = D sum_k h_k W_k^T       dW_k = (D x)^T h_k       db = sum of dy

Forward and backward are the same loop: gather the 27 neighbours of a chunk of leaves into a buffer that stays
in the cache, and multiply. The backward pass gathers once, for both products, and scatters nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ocnf_data.errors import OcnfError
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.neighbours import Neighbours
from ocnf_model.octree.structure import Structure
from ocnf_model.ops.chunks import Chunk, gather, map_chunks, near_rows, plan, put_rows
from ocnf_model.ops.gemm import linear


class OctreeConv3d(nn.Module):
    """conv3d with padding 1 on the expanded volume, then the mean over each leaf; structure unchanged.

    Args:
        in_channels, out_channels: numbers of channels, at least 1.
        bias: whether to add a bias.

    Attributes:
        weight: (C_out, C_in, 3, 3, 3), axes z, y, x; He initialised, for a ReLU to follow.
        bias: (C_out,), zero at first, or None.
    """

    def __init__(self, in_channels: int, out_channels: int, bias: bool = True) -> None:
        super().__init__()
        for field, value in (("in_channels", in_channels), ("out_channels", out_channels)):
            if value < 1:
                raise OcnfError("not a number of channels", where="OctreeConv3d", field=field, found=value,
                                expected="at least 1")
        self.in_channels, self.out_channels = in_channels, out_channels
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, 3, 3, 3))
        self.bias = nn.Parameter(torch.empty(out_channels)) if bias else None
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw the weights after He et al. (2015); zero bias."""
        draw_weights(self.weight, "relu")
        if self.bias is not None:
            nn.init.zeros_(self.bias)

    def forward(self, x: OctreeBatch) -> OctreeBatch:
        """(L, C_in) features to (L, C_out)."""
        return octree_conv(x, self.weight, self.bias)

    def extra_repr(self) -> str:
        """The numbers of channels, and whether there is a bias, for `repr`."""
        return f"{self.in_channels}, {self.out_channels}, bias={self.bias is not None}"


def draw_weights(weight: Tensor, nonlinearity: Literal["relu", "linear"]) -> None:
    """Normal numbers after He et al. (2015), for what has storage.

    For a network that is made for its shapes alone, PyTorch would import its compiler to draw nothing: a
    second of every command that opens a run.
    """
    if not weight.is_meta:
        nn.init.kaiming_normal_(weight, nonlinearity=nonlinearity)


def octree_conv(x: OctreeBatch, weight: Tensor, bias: Tensor | None = None) -> OctreeBatch:
    """The convolution of `OctreeConv3d`, with given weight (C_out, C_in, 3, 3, 3) and bias (C_out,).

    Raises:
        OcnfError: the features have other channels, another dtype or device than the weight.
    """
    features = x.features
    if weight.ndim != 5 or weight.shape[2:] != (3, 3, 3) or weight.shape[1] != x.channels:
        raise OcnfError("channels do not fit", where="OctreeConv3d", field="features", found=x.channels,
                        expected=f"{weight.shape[1]} for a weight {tuple(weight.shape)}")
    if torch.is_autocast_enabled(features.device.type):
        dtype = torch.get_autocast_dtype(features.device.type)
        features, weight = features.to(dtype), weight.to(dtype)
        bias = None if bias is None else bias.to(dtype)
    if (features.dtype, features.device) != (weight.dtype, weight.device):
        raise OcnfError("dtype or device do not fit", where="OctreeConv3d", field="features",
                        found=f"{features.dtype} on {features.device}",
                        expected=f"{weight.dtype} on {weight.device}, as the weight")
    result: Tensor = _Convolution.apply(features, weight, bias, x.structure)
    return x.with_features(result)


class _Convolution(torch.autograd.Function):
    """The forward and the backward pass, by the module's formulas."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, bias: Tensor | None,
                structure: Structure) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.structure = structure
        neighbours = structure.table(Neighbours.build, features.device)
        features = features.contiguous()
        # Columns in the order of a gathered row: offsets, then channels.
        matrix = weight.permute(0, 2, 3, 4, 1).reshape(len(weight), -1)  # (C_out, 27 C_in)
        result = features.new_empty(len(features), len(weight))  # (L, C_out)
        near = near_rows(neighbours, features)

        def convolve(chunks: Sequence[Chunk]) -> None:
            for leaves, gathered in gather(neighbours, features, near, chunks):
                put_rows(result, leaves, linear(gathered, matrix, bias))  # (m, 27 C_in) -> (m, C_out)

        map_chunks(convolve, plan(neighbours, features.shape[1]), features.device)
        return result

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, grad: Tensor
    ) -> tuple[Tensor | None, Tensor | None, Tensor | None, None]:
        features, weight = ctx.saved_tensors
        wants_features, wants_weight, wants_bias, _ = ctx.needs_input_grad
        neighbours = ctx.structure.table(Neighbours.build, features.device)
        volumes = ctx.structure.volumes(grad.device).to(grad.dtype)  # (L, 1)
        scaled = (grad / volumes).contiguous()  # (L, C_out)
        # (C_in, 27 C_out): h_k comes from the offset opposite to k.
        matrix = weight.flip(2, 3, 4).permute(1, 2, 3, 4, 0).reshape(weight.shape[1], -1)
        grad_features = features.new_empty(features.shape) if wants_features else None  # rows, whatever it is

        def convolve_back(chunks: Sequence[Chunk]) -> Tensor:
            # A sum over many chunks is kept in float32 at least.
            grad_matrix = matrix.new_zeros(matrix.shape, dtype=torch.promote_types(grad.dtype, torch.float32))
            for leaves, gathered in gather(neighbours, scaled, near, chunks):
                voxels = volumes.index_select(0, leaves)  # (m, 1)
                if grad_features is not None:
                    put_rows(grad_features, leaves, linear(gathered, matrix).mul_(voxels))
                if wants_weight:
                    rows = features.index_select(0, leaves)  # (m, C_in)
                    if rows.dtype is torch.float16:  # 512 voxels times a feature may be too much for it
                        rows, gathered, voxels = rows.float(), gathered.float(), voxels.float()
                    rows.mul_(voxels)
                    grad_matrix += linear(rows.T, gathered.T)  # (C_in, 27 C_out)
            return grad_matrix

        grad_weight = None
        if wants_features or wants_weight:
            near = near_rows(neighbours, scaled)
            parts = map_chunks(convolve_back, plan(neighbours, grad.shape[1]), grad.device)
            if wants_weight:
                grad_matrix = torch.stack(parts).sum(0).view(weight.shape[1], 3, 3, 3, len(weight))
                grad_weight = grad_matrix.permute(4, 0, 1, 2, 3).flip(2, 3, 4).to(weight.dtype)
        return grad_features, grad_weight, grad.sum(0) if wants_bias else None, None
