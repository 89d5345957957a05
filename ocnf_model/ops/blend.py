"""A blend of a network's TSDF with plain fusion's, with a weight of its own for every leaf."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError

BIN_CENTRES = torch.linspace(-1.125, 1.125, 10).clamp(max=1)
"""TSDF / tau that a vote for each bin of a histogram stands for; the last bin is the free space."""

_LIMIT = 1.25  # of the network's own TSDF
_GAIN = 16.0  # of its linear function, whose weights Adam would else take thousands of steps to let count


class FusionBlend(nn.Module):
    """b times the TSDF of plain fusion + (1 - b) times the network's own, b = sigmoid(16 (w . features + c)).

    The network's own is cut off at 1.25, a bin of the histogram beyond the truncation: were it not, it could
    outvote any share of plain fusion, and did, above all where something is thin.

    Where the votes of many views agree there is nothing to learn, and a network that has to make the same
    number of 16 features loses what is thinner than it has learned. It begins at b = 1/20, so that a network
    that was trained without it stays nearly what it was; `begin_at` sets another.

    Args:
        encoding: what the input says of the views: a histogram, TSDF, or TDF and occupancy.
        column: where the encoding's channels begin among those of the input.
        channels: C, number of features.

    Raises:
        OcnfError: occupancy has no TSDF.
    """

    def __init__(self, encoding: Encoding, column: int, channels: int) -> None:
        super().__init__()
        if encoding is Encoding.OCCUPANCY:
            raise OcnfError("there is no TSDF in this encoding to blend with", where="OctNetFusion",
                            field="blend", found=encoding, expected="false, or another encoding")
        self.encoding, self.column = encoding, column
        self.gate = nn.Linear(channels, 1)
        self.begin_at(0.05)

    def begin_at(self, share: float) -> None:
        """Let b be the same everywhere, above 0 and below 1."""
        nn.init.zeros_(self.gate.weight)
        nn.init.constant_(self.gate.bias, math.log(share / (1 - share)) / _GAIN)

    def forward(self, own: Tensor, features: Tensor, inputs: Tensor) -> Tensor:
        """Network TSDF / tau (L, 1), features (L, C) and inputs (L, c_in) to (L, 1), in at least float32."""
        encoded = inputs[:, self.column:self.column + self.encoding.channels]  # (L, channels)
        plain = plain_tsdf(encoded, self.encoding)                       # (L, 1)
        share = (_GAIN * self.gate(features).to(plain.dtype)).sigmoid()  # (L, 1)
        return torch.lerp(_Truncated.apply(own.to(plain.dtype)), plain, share)


class _Truncated(torch.autograd.Function):
    """Values cut off at -1.25 and 1.25; those beyond get the gradients that lead back, and no others."""

    @staticmethod
    def forward(ctx: Any, own: Tensor) -> Tensor:
        ctx.save_for_backward(own)
        return own.clamp(-_LIMIT, _LIMIT)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (own,) = ctx.saved_tensors
        outwards = (own.abs() > _LIMIT) & (gradient * own < 0)  # a step goes against the gradient
        return gradient.masked_fill(outwards, 0.0)


def plain_tsdf(encoded: Tensor, encoding: Encoding) -> Tensor:
    """TSDF / tau of plain fusion, (L, 1) in at least float32, of inputs (L, channels).

    Of a histogram it is the mean of the bins, which is exact but for votes between 0.875 tau and tau before a
    surface: those are split between two bins, the second of which counts as tau.
    """
    encoded = encoded.to(torch.promote_types(encoded.dtype, torch.float32))
    if encoding is Encoding.HISTOGRAM:
        return (encoded @ BIN_CENTRES.to(encoded)[:, None]).clamp(-1, 1)
    if encoding is Encoding.TDF_OCCUPANCY:
        return encoded[:, :1] * (1 - 2 * encoded[:, 1:])
    return encoded
