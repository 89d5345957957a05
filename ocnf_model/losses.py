"""Losses, equal to those of the dense volumes (SEMANTICS 4).

They are computed on the common refinement of prediction and target, each cell weighed by its voxels. To weigh
the prediction's leaves against the target's leaf means would flatter a coarse prediction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from ocnf_data.errors import OcnfError
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.structure import Structure


class Reduction(StrEnum):
    """What a loss returns."""

    MEAN = "mean"
    """A scalar: the mean over all voxels and channels."""
    NONE = "none"
    """(B,): the mean over each grid."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two batches on their common refinement, at least in float32.

    Attributes:
        structure: L cells, none of which is divided by either batch.
        prediction, target: (L, C) values of the cells.
    """

    structure: Structure
    prediction: Tensor
    target: Tensor

    @classmethod
    def of(cls, prediction: OctreeBatch, target: OctreeBatch) -> Pair:
        """Refine both; differentiable.

        Raises:
            OcnfError: they differ in size, channels or device.
        """
        prediction.structure.check_same_grid(target.structure, "prediction and target")
        if (prediction.channels, prediction.device) != (target.channels, target.device):
            raise OcnfError("prediction and target differ in channels or device", field="target",
                            found=f"{target.channels} on {target.device}",
                            expected=f"{prediction.channels} on {prediction.device}")
        structure = prediction.structure.union(target.structure)
        dtype = torch.promote_types(prediction.features.dtype, torch.float32)
        return cls(structure, prediction.refined(structure).features.to(dtype),
                   target.refined(structure).features.to(dtype))

    def weighed(self, costs: Tensor, weights: OctreeBatch | None) -> Tensor:
        """(L, C) values of cells times the weights there; weights nowhere finer than the cells, None: 1.

        Raises:
            OcnfError: the weights have other than 1 channel, are of other grids, or are finer somewhere.
        """
        if weights is None:
            return costs
        if weights.channels != 1:
            raise OcnfError("not one weight a voxel", field="weights", found=f"{weights.channels} channels",
                            expected=1)
        self.structure.check_same_grid(weights.structure, "weights")
        if self.structure.union(weights.structure) is not self.structure:
            raise OcnfError("finer somewhere than prediction and target", field="weights",
                            found=weights.structure.describe(), expected="none of their cells divided")
        return costs * weights.refined(self.structure).features.to(costs.dtype)  # (L, C) * (L, 1)

    def sum_over_voxels(self, costs: Tensor) -> Tensor:
        """(L, C) values of cells to their sums over the voxels of each grid, (B, C)."""
        weighted = costs * self.structure.volumes(costs.device).to(costs.dtype)  # (L, C) * (L, 1)
        return torch.stack([part.sum(0) for part in weighted.split(self.structure.leaves_per_grid)])  # (B, C)


def l1_loss(prediction: OctreeBatch, target: OctreeBatch, reduction: str = Reduction.MEAN,
            wrong_sign: float = 1.0, weights: OctreeBatch | None = None) -> Tensor:
    """Mean |prediction - target| over the voxels; values in units of tau, not clipped.

    Args:
        prediction: what was predicted.
        target: the ground truth, of the same grids and channels.
        reduction: what is returned.
        wrong_sign: weight of a voxel that is taken for free but is occupied, or the other way round.
        weights: (L, 1) what else the voxels' differences are multiplied by, of the same grids, nowhere finer
            than both the prediction and the target; None: 1.

    Raises:
        OcnfError: they do not fit each other, or `wrong_sign` or `reduction` are none.
    """
    pair = Pair.of(prediction, target)
    return _reduce(pair, _costs(pair, wrong_sign, weights), reduction)


def truncated_l1_loss(prediction: OctreeBatch, target: OctreeBatch,
                      reduction: str = Reduction.MEAN, wrong_sign: float = 1.0,
                      weights: OctreeBatch | None = None) -> Tensor:
    """`l1_loss`, but a prediction beyond 1 costs nothing where the target is 1, nor below -1 where it is -1.

    A TSDF is cut off there, and so is the prediction before it is used or measured: all distances beyond the
    truncation are as right as its very value. A network need not hit 1 exactly in all of the free space.
    """
    pair = Pair.of(prediction, target)
    beyond = (pair.target.abs() >= 1) & (pair.prediction * pair.target.sign() > 1)  # (L, C)
    return _reduce(pair, _costs(pair, wrong_sign, weights).masked_fill(beyond, 0.0), reduction)


def _costs(pair: Pair, wrong_sign: float, weights: OctreeBatch | None) -> Tensor:
    """(L, C) absolute differences, weighed; occupied is TSDF < 0 (SEMANTICS 2)."""
    costs = pair.weighed((pair.prediction - pair.target).abs(), weights)
    if not 0 <= wrong_sign < math.inf:
        raise OcnfError("not a weight", field="wrong_sign", found=wrong_sign, expected="0 or more")
    if wrong_sign == 1:
        return costs
    return torch.where((pair.prediction < 0) == (pair.target < 0), costs, wrong_sign * costs)


def bce_loss(logits: OctreeBatch, occupancy: OctreeBatch, reduction: str = Reduction.MEAN,
             weights: OctreeBatch | None = None) -> Tensor:
    """Mean binary cross entropy over the known voxels, of logits against occupancies in [0, 1].

    A voxel whose occupancy is negative is not known and does not count; a grid without any has the loss 0.
    `weights` as of `l1_loss`; the mean is over voxels all the same, not over weights.

    Raises:
        OcnfError: an occupancy above 1, beside what `Pair.of` raises.
    """
    pair = Pair.of(logits, occupancy)
    if (pair.target > 1 + 1e-5).any():  # means of ones may be off by rounding
        raise OcnfError("not an occupancy", field="occupancy", found=float(pair.target.max()),
                        expected="0 to 1, or below 0 where it is not known")
    known = pair.target >= 0
    costs = binary_cross_entropy_with_logits(pair.prediction, pair.target.clamp(min=0), reduction="none")
    costs = pair.weighed(costs, weights)
    return _reduce(pair, costs * known, reduction, pair.sum_over_voxels(known.double()))


def _reduce(pair: Pair, costs: Tensor, reduction: str, known: Tensor | None = None) -> Tensor:
    """Mean over the voxels, or over `known` (B, C) of them."""
    if reduction not in tuple(Reduction):
        raise OcnfError("no such reduction", field="reduction", found=reduction,
                        expected=" or ".join(Reduction))
    depth, height, width = pair.structure.shape
    sums = pair.sum_over_voxels(costs)  # (B, C)
    if known is None:
        means = sums.mean(1) / (depth * height * width)  # (B,)
    else:
        means = (sums / known.clamp(min=1).to(sums.dtype)).mean(1)
    return means.mean() if reduction == Reduction.MEAN else means
