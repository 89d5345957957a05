"""The encoder-decoder of one resolution (paper section 3.3, SEMANTICS 5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from ocnf_model.network.choices import Join, Normaliser, Output, Widths
from ocnf_model.network.normalise import NormalisedConv3d
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.ops import DenseContext, FusionBlend, OctreeConv3d, concat, grid_pool, grid_unpool
from ocnf_model.ops.conv import draw_weights


@dataclass(frozen=True, eq=False)
class LevelOutput:
    """What a level makes.

    Attributes:
        features: (L, channels[0]) features of the decoder.
        raw: (L, 1) result of the head: TSDF / tau, or logits of occupancy. Losses take this.
        output: which of the two `raw` is.
    """

    features: OctreeBatch
    raw: OctreeBatch
    output: Output

    @property
    def reconstruction(self) -> OctreeBatch:
        """TSDF / tau, not clipped, or probabilities of occupancy, in at least float32.

        Near 1 bfloat16 has steps of 1/256.
        """
        if self.output is Output.TSDF:
            return self.raw
        logits = self.raw.features
        return self.raw.with_features(
            logits.to(torch.promote_types(logits.dtype, torch.float32)).sigmoid())


class Level(nn.Module):
    """The encoder-decoder of one resolution. With channels (16, 32, 64), at resolution r:

    | block   | resolution | layers, each with ReLU         | parameters, concat (add)      |
    |---------|------------|--------------------------------|-------------------------------|
    | first   | r          | 3x3x3 c_in -> 16               | 432 c_in + 16                 |
    | down1   | r          | 3x3x3 16 -> 32; pool           | 13,856                        |
    | down2   | r / 2      | 3x3x3 32 -> 32 -> 64; pool     | 83,040                        |
    | bottom  | r / 4      | 3x3x3 64 -> 64 -> 64 -> 64     | 331,968                       |
    | up2     | r / 2      | unpool; join 64; -> 32 -> 32   | 138,304 (83,008)              |
    | up1     | r          | unpool; join 32; -> 16 -> 16   | 34,592 (20,768)               |
    | head    | r          | 1x1x1 or 3x3x3 16 -> 1, no ReLU| 17 for TSDF, 433 for occupancy|

    Args:
        in_channels: number of input channels.
        channels: number of channels at each of the three resolutions.
        join: how the decoder takes in the encoder's features, a `Join`.
        output: what is reconstructed, an `Output`.
        context: width of the `DenseContext` before the bottom's convolutions; 0 for none (the paper).
        residual: whether a convolution that keeps the number of channels adds its result to its input.
        normalise: what comes between a convolution and its ReLU, a `Normaliser`.
        blend: how the head's TSDF is blended with that of plain fusion; None for not at all (the paper).
    """

    def __init__(self, in_channels: int, channels: Widths, join: Join, output: Output,
                 context: int = 0, residual: bool = False, normalise: Normaliser = Normaliser.NONE,
                 blend: FusionBlend | None = None) -> None:
        super().__init__()
        self.join, self.output, self.checkpointing = join, output, False
        self.residual, self.normalise = residual, normalise
        wide, middle, deep = channels
        joined = 2 if join is Join.CONCAT else 1
        convs = partial(_convs, normalise)
        self.first = convs(in_channels, wide)
        self.down1 = convs(wide, middle)
        self.down2 = convs(middle, middle, deep)
        self.context = DenseContext(deep, context) if context else None
        self.bottom = convs(deep, deep, deep, deep)
        self.up2 = convs(joined * deep, middle, middle)
        self.up1 = convs(joined * middle, wide, wide)
        self.head: nn.Linear | OctreeConv3d
        if output is Output.OCCUPANCY:
            self.head = OctreeConv3d(wide, 1)
        else:
            self.head = nn.Linear(wide, 1)
            draw_weights(self.head.weight, "linear")
            nn.init.zeros_(self.head.bias)
        self.blend = blend

    def forward(self, x: OctreeBatch) -> LevelOutput:
        """(L, c_in) features to those of the decoder and of the head."""
        fine = self._run(self.down1, self._run(self.first, x))
        middle = self._run(self.down2, grid_pool(fine))
        deep = grid_pool(middle)
        if self.context is not None:
            deep = self.context(deep)
        deep = self._run(self.bottom, deep)
        middle = self._run(self.up2, self._joined(deep, middle))
        features = self._run(self.up1, self._joined(middle, fine))
        if isinstance(self.head, OctreeConv3d):
            return LevelOutput(features, self.head(features), self.output)
        with torch.autocast(features.device.type, enabled=False):  # 16 products, but the surface's last bits
            read = features.features.to(self.head.weight.dtype)
            raw = self.head(read)
            if self.blend is not None:
                raw = self.blend(raw, read, x.features)
        return LevelOutput(features, features.with_features(raw), self.output)

    def _joined(self, coarse: OctreeBatch, skipped: OctreeBatch) -> OctreeBatch:
        up = grid_unpool(coarse, guide=skipped)
        if self.join is Join.CONCAT:
            return concat(up, skipped)
        return up.with_features(up.features + skipped.features)

    def _run(self, convs: nn.ModuleList, x: OctreeBatch) -> OctreeBatch:
        if self.checkpointing and torch.is_grad_enabled():
            result: OctreeBatch = checkpoint(_conv_relu, convs, x, self.residual, use_reentrant=False,
                                             preserve_rng_state=False)
            return result
        return _conv_relu(convs, x, self.residual)


def _convs(normalise: Normaliser, *channels: int) -> nn.ModuleList:
    kind = OctreeConv3d if normalise is Normaliser.NONE else NormalisedConv3d
    return nn.ModuleList(kind(a, b) for a, b in pairwise(channels))


def _conv_relu(convs: nn.ModuleList, x: OctreeBatch, residual: bool) -> OctreeBatch:
    for conv in convs:
        y = conv(x)
        features = y.features.relu_()  # in place: a convolution does not need its result again
        if residual and y.channels == x.channels:
            features = features + x.features
        x = y.with_features(features)
    return x
