"""Batch normalisation between a convolution and its ReLU, and how to be rid of it after training."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.ops import OctreeConv3d

_EPS = 1e-5  # added to the variance
_NORM = ".norm."
_MEAN = f"{_NORM}running_mean"


class NormalisedConv3d(OctreeConv3d):
    """An `OctreeConv3d` without a bias, then batch normalisation over all leaves of the batch."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(in_channels, out_channels, bias=False)
        self.norm = nn.BatchNorm1d(out_channels, eps=_EPS, momentum=0.05)

    def forward(self, x: OctreeBatch) -> OctreeBatch:
        """(L, C_in) features to (L, C_out)."""
        y = super().forward(x)
        return y.with_features(self.norm(y.features))


def freeze_statistics(module: nn.Module) -> None:
    """Let batch normalisation scale and shift by what it has gathered so far, until the next `train()`.

    In training it uses the statistics of the batch, in use the running ones. Weights that were fitted to the
    one are not the best ones for the other, least of all with one or two samples a batch.
    """
    for part in module.modules():
        if isinstance(part, nn.BatchNorm1d):
            part.eval()


def fold_normalisation(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of a `Level` without batch normalisation that computes what one with it does in evaluation.

    There it is a fixed scale and shift of each channel, so the scale goes into the convolution's weights and
    the shift becomes its bias.

    Args:
        weights: state of a level whose `normalise` is `batch`, or of any other, which stays what it is.
    """
    folded = {name: value for name, value in weights.items() if _NORM not in name}
    for convolution in (name.removesuffix(_MEAN) for name in weights if name.endswith(_MEAN)):
        mean, variance, weight, bias = (weights[f"{convolution}{_NORM}{part}"]
                                        for part in ("running_mean", "running_var", "weight", "bias"))  # (C,)
        scale = weight / (variance + _EPS).sqrt()
        folded[f"{convolution}.weight"] = weights[f"{convolution}.weight"] * scale[:, None, None, None, None]
        folded[f"{convolution}.bias"] = bias - mean * scale
    return folded
