"""Where the error lies: the MAD divided into what the inputs see and do not see, of each part of the truth.

| | truth exactly 1: free | between: band | truth exactly -1: inside |
|---|---|---|---|
| **seen**: at least one input view counts | `seen_free` | `seen_band` | `seen_inside` |
| **unseen**: none does | `unseen_free` | `unseen_band` | `unseen_inside` |

A view counts for a voxel if the voxel projects, in front of the camera, onto a pixel that has a measurement,
or onto a ray that hits nothing, and lies no more than tau behind what was measured (SEMANTICS 2). The six are
contributions: each is the sum of |prediction - truth| over its voxels, divided by the number of all voxels of
the cube, so that they sum to the MAD.

Whether a voxel is seen can be read from a stored histogram exactly: unseen is all weight in the first bin,
and a view that counts gives at most half of its vote there. A stored TSDF is rounded to 1/128 tau, so that
what is seen at -tau, to within 1/256 tau, looks unseen; the same holds for TDF and occupancy. An input of
occupancy does not tell at all.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from math import nan

import torch
from torch import Tensor

from ocnf_data.encodings import Encoding
from ocnf_model.losses import Pair
from ocnf_model.octree.batch import OctreeBatch

EXACT = (Encoding.HISTOGRAM,)
"""Encodings that tell exactly which voxels are seen."""
NEARLY = (Encoding.TSDF, Encoding.TDF_OCCUPANCY)
"""Encodings that tell it but for voxels seen within 1/256 (1/510) tau of -tau."""


@dataclass(frozen=True)
class Regions:
    """Contributions to the MAD, in millimetres; NaN where they are not known."""

    seen_free: float = nan
    seen_band: float = nan
    seen_inside: float = nan
    unseen_free: float = nan
    unseen_band: float = nan
    unseen_inside: float = nan

    @property
    def total(self) -> float:
        """The MAD."""
        return sum(astuple(self))


def seen_by(encoded: OctreeBatch, encoding: Encoding) -> OctreeBatch | None:
    """1 where an input says that a view counts, 0 where none does; None where it does not tell.

    Args:
        encoded: an encoding of the input views, as stored or as fused.
        encoding: which.
    """
    values = encoded.features
    if encoding is Encoding.HISTOGRAM:
        unseen = values[:, :1] >= 1
    elif encoding is Encoding.TSDF:
        unseen = values <= -1
    elif encoding is Encoding.TDF_OCCUPANCY:
        unseen = (values >= 1).all(1, keepdim=True)
    else:
        return None
    return encoded.with_features((~unseen).to(torch.float32))


@torch.no_grad()
def mad_by_region(prediction: OctreeBatch, truth: OctreeBatch, seen: OctreeBatch, tau: float) -> Tensor:
    """(B, 6) float64: the contributions of each volume's regions in millimetres, in the order of `Regions`.

    Args:
        prediction: TSDF / tau; clipped to [-1, 1] here.
        truth: the same.
        seen: 1 where an input view counts, 0 elsewhere; of the same resolution, on a structure of its own.
        tau: truncation distance in metres.
    """
    structure = prediction.structure.union(truth.structure).union(seen.structure)
    pair = Pair.of(prediction.refined(structure), truth.refined(structure))
    unseen = seen.refined(structure).features <= 0.5
    target = pair.target.clamp(-1, 1)
    costs = (pair.prediction.clamp(-1, 1).double() - target.double()).abs()
    costs *= structure.volumes(costs.device)
    region = 3 * unseen.long() + (target < 1).long() + (target <= -1).long()
    depth, height, width = structure.shape
    sums = [torch.bincount(where[:, 0], cost[:, 0], minlength=6) for where, cost in zip(
        region.split(structure.leaves_per_grid), costs.split(structure.leaves_per_grid), strict=True)]
    return torch.stack(sums) / (depth * height * width) * (1000 * tau)
