"""A level's weights as those of a wider one that computes the same (Net2WiderNet, Chen et al. 2016)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ocnf_model.network.choices import Widths

_WIDE, _MIDDLE, _DEEP = range(3)  # widths within a level
_SAME = None  # a number of channels that stays as it is

# What each layer of a level reads (perhaps twice, side by side) and what it makes.
_LAYERS: Mapping[str, tuple[int | None, int | None]] = {
    "first.0": (_SAME, _WIDE),
    "down1.0": (_WIDE, _MIDDLE),
    "down2.0": (_MIDDLE, _MIDDLE),
    "down2.1": (_MIDDLE, _DEEP),
    "context.down1.0": (_DEEP, _SAME),
    "context.out": (_SAME, _DEEP),
    "bottom.0": (_DEEP, _DEEP),
    "bottom.1": (_DEEP, _DEEP),
    "bottom.2": (_DEEP, _DEEP),
    "up2.0": (_DEEP, _MIDDLE),
    "up2.1": (_MIDDLE, _MIDDLE),
    "up1.0": (_MIDDLE, _WIDE),
    "up1.1": (_WIDE, _WIDE),
    "head": (_WIDE, _SAME),
    "blend.gate": (_WIDE, _SAME),
}


def widened(weights: Mapping[str, Tensor], before: Widths, after: Widths, seed: int) -> dict[str, Tensor]:
    """The state of a `Level` of more channels that computes what a narrower one does.

    Each new channel is a copy of an old one, and whoever reads that one reads a part of it from either. The
    parts are drawn for every weight, or copies would learn the same for ever.

    Args:
        weights: state of the narrower level, with or without batch normalisation, context and blend, but not
            residual: which convolutions add their input depends on the channels.
        before: its channels at the three resolutions within it.
        after: those of the wider one, none below.
        seed: of the parts.
    """
    generator = torch.Generator().manual_seed(seed)
    result = dict(weights)
    for name, tensor in weights.items():
        layer = next((layer for layer in _LAYERS if name.startswith(f"{layer}.")), None)
        if layer is None or tensor.ndim == 0:  # the inside of the context; a count of batches
            continue
        reads, makes = _LAYERS[layer]
        wider = tensor
        if reads is not None and tensor.ndim > 1:  # else a bias, or a statistic
            parts = tensor.split(before[reads], 1)
            wider = torch.cat([_shared(part, after[reads], generator) for part in parts], 1)
        result[name] = wider if makes is None else wider[_copied(before[makes], after[makes])]
    return result


def reading_wider(weight: Tensor, before: int, after: int, seed: int) -> Tensor:
    """The weight of a convolution (C_out, C_in, 3, 3, 3) whose first `before` inputs have become `after`."""
    shared = _shared(weight[:, :before], after, torch.Generator().manual_seed(seed))
    return torch.cat([shared, weight[:, before:]], 1)


def _copied(before: int, after: int) -> Tensor:
    """The old channel that each new one is a copy of."""
    return torch.arange(after) % before


def _shared(weight: Tensor, after: int, generator: torch.Generator) -> Tensor:
    """(C_out, before, ...) to (C_out, after, ...): the weights of copies sum to those of what they copy."""
    copied = _copied(weight.shape[1], after)
    parts = 0.2 + 0.6 * torch.rand(weight.shape[0], after, dtype=torch.float64, generator=generator)
    sums = parts.new_zeros(weight.shape[:2]).index_add(1, copied, parts)
    share = (parts / sums[:, copied]).to(weight.dtype)
    return weight[:, copied] * share.reshape(*share.shape, *[1] * (weight.ndim - 2))
