"""Global context: a small dense encoder-decoder on a coarse grid, added to the features of an octree."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool3d, interpolate

from ocnf_data.errors import OcnfError
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.ops.concat import on_structure_of

_GROUP = 16  # channels that are normalised together


class DenseContext(nn.Module):
    """Adds to each leaf what the whole volume says: features from a quarter of the resolution, dense.

    The encoder-decoder of a level sees about 30 voxels around each voxel. Whether a hollow that no view looks
    into is a cup or a solid is decided farther away, so the features are pooled twice more, convolved where a
    kernel spans a large part of the volume, and brought back:

    | at            | layers, each with GroupNorm and ReLU       |
    |---------------|--------------------------------------------|
    | 1/2           | mean of 8; 3x3x3 C -> W -> W               |
    | 1/4           | mean of 8; 3x3x3 W -> W -> W               |
    | 1/2           | trilinear; beside the 1/2; 3x3x3 2 W -> W  |
    | 1             | 1x1x1 W -> C, no norm; trilinear; added    |

    The last layer begins at zero, so that a new module changes nothing.

    Args:
        channels: C of the features.
        width: W, a multiple of 16.
    """

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        if width < _GROUP or width % _GROUP:
            raise OcnfError("not a width", where="OctNetFusion", field="context", found=width,
                            expected=f"0, or a multiple of {_GROUP}")
        self.down1 = nn.Sequential(*_conv(channels, width), *_conv(width, width))
        self.down2 = nn.Sequential(*_conv(width, width), *_conv(width, width))
        self.up = nn.Sequential(*_conv(2 * width, width))
        self.out = nn.Conv3d(width, channels, 1)
        for parameter in self.out.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: OctreeBatch) -> OctreeBatch:
        """(L, C) features on grids whose sides are multiples of 8 voxels to (L, C)."""
        volume = x.to_dense()                                                     # (B, C, D, H, W)
        half = self.down1(avg_pool3d(volume, 2))                                   # (B, W, D/2, H/2, W/2)
        quarter = _doubled(self.down2(avg_pool3d(half, 2)))                     # (B, W, D/2, H/2, W/2)
        context = _doubled(self.out(self.up(torch.cat([quarter, half], 1))))  # (B, C, D, H, W)
        means = on_structure_of(x, OctreeBatch.full(context.to(x.features.dtype)), "context")
        return x.with_features(x.features + means)


def _conv(into: int, out: int) -> tuple[nn.Module, ...]:
    return nn.Conv3d(into, out, 3, padding=1, bias=False), nn.GroupNorm(out // _GROUP, out), nn.ReLU()


def _doubled(x: Tensor) -> Tensor:
    return interpolate(x, scale_factor=2, mode="trilinear", align_corners=False)
