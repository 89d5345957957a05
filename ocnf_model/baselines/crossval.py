"""The weight of TV-L1 by cross-validation: the one with the least MAD on models with known ground truth.

The best weight depends on the resolution, the noise and the number of views, so it is chosen for each
resolution and input variant apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_model.baselines.total_variation import tvl1
from ocnf_model.metrics import grid_mad_mm

Case = tuple[GridOctree, GridOctree, float]
"""(histogram, ground truth TSDF / tau, tau in metres) of one model."""

CANDIDATE_WEIGHTS = (0.4, 0.64, 1.0, 1.6, 2.5, 4.0, 6.4)
_MIN_WEIGHTS = 6
_MAX_WEIGHTS = 24
_PLATEAU = 1e-4
"""The MAD has settled at an end where it falls by less than this share from one weight to the next."""


@dataclass(frozen=True)
class WeightChoice:
    """The outcome of `choose_weight`.

    Attributes:
        weight: the best one.
        weights: (N,) all that were tried, ascending: the given ones, and those that the grid grew by.
        mad_mm: (N, models) MAD of each model in millimetres, over all voxels of the cube.
    """

    weight: float
    weights: F64
    mad_mm: F64

    @property
    def mean_mm(self) -> F64:
        """(N,) mean over the models, in millimetres: what is minimised."""
        return np.asarray(self.mad_mm.mean(axis=1))

    def table(self) -> str:
        """A Markdown table of the weights, best one marked."""
        rows = [f"| {weight:.4g} | {mad:.4f} |{' best' if weight == self.weight else ''}"
                for weight, mad in zip(self.weights, self.mean_mm, strict=True)]
        return "\n".join(["| weight | MAD mm |", "| -----: | -----: |", *rows])


def choose_weight(cases: Iterable[Case], weights: Sequence[float] = CANDIDATE_WEIGHTS, *,
                  iterations: int = 5000, tolerance: float = 5e-5,
                  progress: Callable[[float, int, float], None] | None = None) -> WeightChoice:
    """The weight with the least MAD, mean over the models.

    A best weight at an end of the grid says that the optimum may lie beyond it: the grid then grows there, by
    the ratio of its last two weights, until the best is inside or the MAD has settled.

    Args:
        cases: models of one resolution; all are held in memory, at 256^3 some 25 MB each.
        weights: at least 6 weights, ascending, above 0.
        iterations: upper limit of each solve, as for `tvl1`.
        tolerance: relative gap at which each solve stops, as for `tvl1`.
        progress: called as (weight, model, MAD in mm) after each solve.

    Raises:
        OcnfError: no models, models of several resolutions, too few weights or no grid of them; no optimum
            within 24 weights.
    """
    models = _checked_cases(cases)
    grid = _checked_weights(weights)

    def measure(weight: float) -> list[float]:
        mads = []
        for i, (histogram, truth, tau) in enumerate(models):
            mads.append(grid_mad_mm(tvl1(histogram, weight, iterations, tolerance), truth, tau))
            if progress is not None:
                progress(weight, i, mads[-1])
        return mads

    tried = {weight: measure(weight) for weight in grid}
    while True:
        order = sorted(tried)
        means = [float(np.mean(tried[weight])) for weight in order]
        best = int(np.argmin(means))
        inner = {0: 1, len(order) - 1: len(order) - 2}.get(best)
        if inner is None or means[inner] - means[best] <= _PLATEAU * means[best]:
            return WeightChoice(order[best], np.array(order), np.array([tried[weight] for weight in order]))
        if len(order) >= _MAX_WEIGHTS:
            raise OcnfError("no optimum among the weights", where="choose_weight", field="weights",
                            found=f"the best at {order[best]:.3g}, an end of the grid")
        beyond = order[best] ** 2 / order[inner]
        tried[beyond] = measure(beyond)


def _checked_cases(cases: Iterable[Case]) -> list[Case]:
    models = list(cases)
    if not models:
        raise OcnfError("no models to choose a weight on", code="empty", where="choose_weight", field="cases")
    shapes = {octree.shape for histogram, truth, _ in models for octree in (histogram, truth)}
    if len(shapes) > 1:
        raise OcnfError("models of several resolutions", where="choose_weight", field="cases",
                        found=sorted(shapes), expected="one: the best weight depends on it")
    return models


def _checked_weights(weights: Sequence[float]) -> list[float]:
    grid = [float(weight) for weight in weights]
    if len(grid) < _MIN_WEIGHTS:
        raise OcnfError("too few weights", where="choose_weight", field="weights", found=len(grid),
                        expected=f"{_MIN_WEIGHTS} or more")
    if not (np.isfinite(grid).all() and grid[0] > 0 and all(np.diff(grid) > 0)):
        raise OcnfError("not a grid of weights", where="choose_weight", field="weights", found=weights,
                        expected="ascending, above 0")
    return grid
