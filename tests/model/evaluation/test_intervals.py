"""Bootstrap intervals: they cover as often as they say, and keep a model's two errors together."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ocnf_model.evaluation.intervals import bootstrap_ratio


def test_an_interval_covers_the_true_ratio_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(150):
        theirs = rng.gamma(4.0, 1.0, 60)
        ours = 0.5 * theirs * rng.gamma(10.0, 0.1, 60)  # the true ratio of means is 0.5
        found = bootstrap_ratio(ours, theirs)
        covered += found.low <= 0.5 <= found.high
    assert 0.87 < covered / 150 < 0.99


def test_the_same_share_of_every_error_has_no_interval() -> None:
    theirs = np.random.default_rng(0).gamma(1.0, 1.0, 30)
    found = bootstrap_ratio(0.4 * theirs, theirs)
    assert found.value == pytest.approx(0.4)
    assert (found.low, found.high) == (pytest.approx(0.4), pytest.approx(0.4))


def test_it_is_the_ratio_of_means_not_the_mean_of_ratios_and_repeats_itself() -> None:
    ours, theirs = [1.0, 1.0, 4.0], [2.0, 1.0, 10.0]
    found = bootstrap_ratio(ours, theirs)
    assert found.value == pytest.approx(6 / 13)
    assert found.low < found.value < found.high and found == bootstrap_ratio(ours, theirs)


@pytest.mark.parametrize(("ours", "theirs"), [([], []), ([1.0, math.nan], [1.0, 1.0]), ([1.0], [0.0])])
def test_what_has_no_ratio_has_none(ours, theirs) -> None:
    found = bootstrap_ratio(ours, theirs)
    assert all(math.isnan(value) for value in (found.value, found.low, found.high))


def test_one_model_has_a_ratio_without_an_interval() -> None:
    found = bootstrap_ratio([1.0], [4.0])
    assert found.value == 0.25 and math.isnan(found.low)
