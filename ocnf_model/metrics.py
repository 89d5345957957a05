"""What evaluation reports of each volume; equal to the same figures of the dense volumes (SEMANTICS 5)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ocnf_data.octree import GridOctree
from ocnf_model.losses import Pair
from ocnf_model.octree.batch import OctreeBatch


@torch.no_grad()
def mad_mm(prediction: OctreeBatch, truth: OctreeBatch, tau: float) -> Tensor:
    """(B,) float64: mean |prediction - truth| over all voxels of each volume, in millimetres.

    Args:
        prediction: TSDF / tau; clipped to [-1, 1] here.
        truth: TSDF / tau, also clipped.
        tau: truncation distance in metres.
    """
    pair = Pair.of(prediction, truth)
    depth, height, width = pair.structure.shape
    costs = (pair.prediction.clamp(-1, 1).double() - pair.target.clamp(-1, 1).double()).abs()
    return pair.sum_over_voxels(costs).mean(1) / (depth * height * width) * (1000 * tau)


@torch.no_grad()
def known_mad_mm(prediction: OctreeBatch, truth: OctreeBatch, tau: float) -> Tensor:
    """(B,) float64: `mad_mm` over the voxels that the truth knows alone; NaN where it knows none.

    Those are all but the ones that are exactly -tau: inside of things, or, of a scan, unknown, because no
    frame has looked there. What stands there is no mistake that a truth without knowledge could show.
    """
    pair = Pair.of(prediction, truth)
    target = pair.target.clamp(-1, 1)
    known = (target > -1).double()
    costs = (pair.prediction.clamp(-1, 1).double() - target.double()).abs() * known
    return pair.sum_over_voxels(costs).sum(1) / pair.sum_over_voxels(known).sum(1) * (1000 * tau)


def grid_mad_mm(prediction: GridOctree, truth: GridOctree, tau: float) -> float:
    """`mad_mm` of one octree against another."""
    return mad_mm(OctreeBatch.from_grids([prediction]), OctreeBatch.from_grids([truth]), tau).item()


@torch.no_grad()
def occupancy_mad(prediction: OctreeBatch, truth: OctreeBatch) -> Tensor:
    """(B,) float64: mean difference of probabilities over the voxels whose truth is known, not negative."""
    pair = Pair.of(prediction, truth)
    known = (pair.target >= 0).double()
    costs = (pair.prediction.double() - pair.target.double()).abs() * known
    return (pair.sum_over_voxels(costs) / pair.sum_over_voxels(known).clamp(min=1)).mean(1)


@dataclass(frozen=True, eq=False)
class Overlap:
    """Voxels of each volume, (B,) float64, that are occupied in both, and in only one of the two.

    Where nothing is predicted but something is true, or the other way round, all shares are 0; where nothing
    is predicted nor true, all are 1.
    """

    both: Tensor
    only_predicted: Tensor
    only_true: Tensor

    @property
    def iou(self) -> Tensor:
        """Intersection over union, (B,)."""
        return self._share_of(self.both + self.only_predicted + self.only_true)

    @property
    def precision(self) -> Tensor:
        """Share of what is predicted that is true, (B,)."""
        return self._share_of(self.both + self.only_predicted)

    @property
    def recall(self) -> Tensor:
        """Share of what is true that is predicted, (B,)."""
        return self._share_of(self.both + self.only_true)

    def _share_of(self, whole: Tensor) -> Tensor:
        """What is in both, as a share of the whole."""
        nothing = self.both + self.only_predicted + self.only_true == 0
        return torch.where(whole > 0, self.both / whole.clamp(min=1), nothing.to(whole.dtype))


@torch.no_grad()
def tsdf_overlap(prediction: OctreeBatch, truth: OctreeBatch) -> Overlap:
    """Overlap of the occupied voxels: those whose TSDF is below 0, as in the occupancy target."""
    pair = Pair.of(prediction, truth)
    return _overlap(pair, pair.prediction < 0, pair.target < 0)


@torch.no_grad()
def occupancy_overlap(prediction: OctreeBatch, truth: OctreeBatch) -> Overlap:
    """Overlap of the voxels whose probability is 0.5 or more; a negative truth is not known, and ignored."""
    pair = Pair.of(prediction, truth)
    return _overlap(pair, (pair.prediction >= 0.5) & (pair.target >= 0), pair.target >= 0.5)


def _overlap(pair: Pair, predicted: Tensor, true: Tensor) -> Overlap:
    def count(cells: Tensor) -> Tensor:
        return pair.sum_over_voxels(cells.double()).sum(1)

    return Overlap(count(predicted & true), count(predicted & ~true), count(~predicted & true))
