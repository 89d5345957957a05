"""The choice of the weight, and the metric it goes by."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_model.baselines import choose_weight
from ocnf_model.metrics import grid_mad_mm


def as_case(scan: Any) -> tuple[GridOctree, GridOctree, float]:
    return scan.histogram, scan.truth, scan.tau


def test_mad_is_the_dense_one(chair32: Any) -> None:
    ours = GridOctree.from_dense(1.3 * chair32.volfus.to_dense(), 0.2)  # coarser, and beyond [-1, 1]
    expected = abs(np.clip(ours.to_dense(), -1, 1).astype(np.float64) - chair32.truth.to_dense()).mean()
    assert grid_mad_mm(ours, chair32.truth, chair32.tau) \
        == pytest.approx(expected * chair32.tau * 1e3, rel=1e-12)


def test_the_least_mean_is_chosen(chair32: Any, sphere32: Any) -> None:
    seen = []
    choice = choose_weight(iter([as_case(chair32), as_case(sphere32)]),
                           progress=lambda weight, model, mad: seen.append((weight, model, mad)))
    assert choice.mad_mm.shape == (len(choice.weights), 2)
    assert (np.diff(choice.weights) > 0).all()
    assert choice.weight == choice.weights[np.argmin(choice.mean_mm)]
    assert len(seen) == choice.mad_mm.size
    assert choice.table().count("best") == 1


@pytest.mark.parametrize("weights", [[0.3 * 1.2**i for i in range(6)], [60 * 1.5**i for i in range(6)]])
def test_an_optimum_at_the_end_extends_the_grid(weights: list[float], sphere32: Any) -> None:
    choice = choose_weight([as_case(sphere32)], weights)
    assert set(weights) < set(choice.weights)
    assert choice.weights[0] < choice.weight < choice.weights[-1]


def test_bad_arguments(chair32: Any) -> None:
    case = as_case(chair32)
    small = GridOctree.from_dense(np.zeros((1, 8, 8, 8), np.float32))
    for cases, weights, field in [
        ([], [1, 2, 3, 4, 5, 6], "cases"),
        ([case, (case[0], small, case[2])], [1, 2, 3, 4, 5, 6], "cases"),
        ([case], [1, 2, 3, 4, 5], "weights"),
        ([case], [1, 2, 3, 4, 5, 5], "weights"),
        ([case], [0, 1, 2, 3, 4, 5], "weights"),
    ]:
        with pytest.raises(OcnfError) as caught:
            choose_weight(cases, weights)
        assert caught.value.field == field
