"""IoU, precision and recall against counts by hand and by sets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_model.completion.scores import Scores


@given(seed=st.integers(0, 2**32), likely=st.floats(0, 1))
def test_equals_sets_of_voxels(seed: int, likely: float) -> None:
    rng = np.random.default_rng(seed)
    occupied, predicted, judged = (rng.random((3, 4, 5)) < p for p in (0.4, likely, 0.7))
    truth, guess = ({tuple(at) for at in np.argwhere(which & judged)} for which in (occupied, predicted))
    found = Scores.of(occupied, predicted, judged)
    both = len(truth & guess)
    assert found.iou == (both / len(truth | guess) if truth | guess else 0)
    assert found.precision == (both / len(guess) if guess else 0)
    assert found.recall == (both / len(truth) if truth else 0)


def test_a_mean_is_of_frames_and_not_of_voxels() -> None:
    small, large = np.ones((1, 1, 1), bool), np.ones((9, 9, 9), bool)
    mean = Scores.mean([Scores.of(small, ~small, small), Scores.of(large, large, large)])
    assert mean == Scores(0.5, 0.5, 0.5)


def test_what_cannot_be_scored_is_refused() -> None:
    with pytest.raises(OcnfError, match="differ in size"):
        Scores.of(np.ones((2, 2, 2), bool), np.ones((2, 2, 3), bool), np.ones((2, 2, 2), bool))
    with pytest.raises(OcnfError, match="no frames"):
        Scores.mean([])
