"""How sure a ratio is: bootstrap over the models (Efron and Tibshirani 1993)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan

import numpy as np

_RESAMPLES = 2000
_SEED = 0


@dataclass(frozen=True)
class Ratio:
    """A ratio of two means over the same models.

    Attributes:
        value: the ratio over all models.
        low, high: 95 % of the ratios of resamples lie between; NaN for fewer than two models.
    """

    value: float = nan
    low: float = nan
    high: float = nan


def bootstrap_ratio(ours: Sequence[float], theirs: Sequence[float]) -> Ratio:
    """The mean of `ours` over the mean of `theirs`, with the percentile interval over the models.

    2,000 times as many models are drawn as there are, with replacement, and both means are taken over those:
    a model's two errors stay together, so that what is hard for both methods does not widen the interval. The
    draws have a fixed seed. The interval says how much other models of the same kinds would change the ratio;
    it says nothing about other kinds.

    Args:
        ours: (n,) errors of a method on n models.
        theirs: (n,) those of another on the same models, in the same order.
    """
    pairs = np.array([ours, theirs], np.float64)
    if not pairs.size or not np.isfinite(pairs).all() or not pairs[1].sum() > 0:
        return Ratio()
    value = float(pairs[0].sum() / pairs[1].sum())
    n = pairs.shape[1]
    if n < 2:
        return Ratio(value)
    sums = pairs[:, np.random.default_rng(_SEED).integers(0, n, (_RESAMPLES, n))].sum(axis=2)
    low, high = np.percentile(sums[0][sums[1] > 0] / sums[1][sums[1] > 0], [2.5, 97.5])
    return Ratio(value, float(low), float(high))


def bootstrap_mean(values: Sequence[float]) -> Ratio:
    """The mean over the models with the same percentile interval: a ratio to 1.

    Args:
        values: (n,) a figure of each model.
    """
    return bootstrap_ratio(values, [1.0] * len(values))
