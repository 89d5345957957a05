"""The shared part of Voxlets: its splits, and the figures of what needs no learning; needs OCNF_DATA."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from ocnf_model.completion.baselines import all_occupied, visible_band
from ocnf_model.completion.scores import Scores
from ocnf_model.completion.visible import Visible
from ocnf_model.completion.voxlets import list_frames

DATA = Path(os.environ.get("OCNF_DATA", "")) / "voxlets"
pytestmark = pytest.mark.skipif("OCNF_DATA" not in os.environ or not DATA.is_dir(),
                                reason="OCNF_DATA names no folder with voxlets/")


def test_the_splits_are_24_scenes_of_five_frames_and_14_of_one() -> None:
    train, test = list_frames(DATA, "train"), list_frames(DATA, "test")
    assert (len(train), len({frame.scene for frame in train}), len(test)) == (120, 24, 14)
    assert len({frame.scene for frame in test}) == 14
    assert not {frame.scene for frame in test} & {frame.scene for frame in train}


def test_the_figures_of_what_needs_no_learning() -> None:
    rows: dict[str, list[Scores]] = {"everything": [], "band": []}
    for frame in list_frames(DATA, "test"):
        scene = frame.read()
        judged = Visible.of(scene.view, scene.shape, scene.voxel).judged
        for name, method in (("everything", all_occupied), ("band", visible_band)):
            rows[name].append(Scores.of(scene.occupied, method(scene), judged))
    full, band = Scores.mean(rows["everything"]), Scores.mean(rows["band"])
    np.testing.assert_allclose([full.iou, full.precision, full.recall], [0.170, 0.170, 1], atol=1e-3)
    np.testing.assert_allclose([band.iou, band.precision, band.recall], [0.268, 0.815, 0.286], atol=1e-3)
