"""The completion network that comes with the package: whole, described, and better than the baselines."""

from __future__ import annotations

import os
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import open_run
from ocnf_model.completion import evaluate
from ocnf_model.completion.predict import CompletionNetwork, read_threshold
from ocnf_model.completion.scores import Scores
from ocnf_model.completion.single import complete_view
from ocnf_model.completion.table import VOXEL
from ocnf_model.completion.visible import Visible

FOLDER = Path(str(files("ocnf_model"))) / "pretrained" / "completion"
DATA = Path(os.environ.get("OCNF_DATA", "")) / "voxlets"


def test_the_levels_are_there_and_go_together() -> None:
    run = open_run(FOLDER)
    network = CompletionNetwork("pretrained", "cpu")
    assert network.n_levels == len(run.headers) and network.threshold == read_threshold(FOLDER) != 0.5
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 8e6
    card = (FOLDER / "README.md").read_text()
    for header in run.headers:
        row = f"| {header.level} | {header.epoch} | {header.steps:,} | {header.metrics['iou']:.3f} |"
        assert row in card


def test_a_network_of_another_kind_is_refused() -> None:
    with pytest.raises(OcnfError, match="not for completion"):
        CompletionNetwork(FOLDER.parent, "cpu")


@pytest.mark.slow
@pytest.mark.skipif("OCNF_DATA" not in os.environ or not DATA.is_dir(),
                    reason="OCNF_DATA names no folder with voxlets/")
def test_better_than_the_baselines_on_the_test_scenes(tmp_path: Path,
                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    """On every fourth frame, for time."""
    everything = evaluate.list_frames
    monkeypatch.setattr(evaluate, "list_frames", lambda *which: everything(*which)[::4])
    rows = evaluate.run_completion_evaluation("pretrained", str(DATA), out=tmp_path, forest=False, figures=0,
                                              device="cpu")
    means = {method: Scores.mean([row.scores for row in rows if row.method == method])
             for method in {row.method for row in rows}}
    ours = means.pop("ours")
    assert ours.iou >= 0.6 > max(mean.iou for mean in means.values())


@pytest.mark.slow
@pytest.mark.skipif("OCNF_DATA" not in os.environ or not DATA.is_dir(),
                    reason="OCNF_DATA names no folder with voxlets/")
def test_as_good_where_it_has_to_find_the_table_itself() -> None:
    """On every second test frame: the scene's volume is in the world of its frames, which is not told."""
    network, found = CompletionNetwork("pretrained", "cpu"), []
    for frame in evaluate.list_frames(str(DATA), "test")[::2]:
        scene = frame.read()
        completed = complete_view(network, scene.view, frame.name)
        at = (np.indices(scene.shape)[::-1].reshape(3, -1).T + 0.5) * scene.voxel
        placed = at @ completed.grid.to_grid[:3, :3].T + completed.grid.to_grid[:3, 3]
        cells = np.floor(placed / VOXEL).astype(int)[:, ::-1]
        within = ((cells >= 0) & (cells < completed.grid.shape)).all(axis=1)
        occupied = np.zeros(len(at), bool)
        occupied[within] = completed.occupied[tuple(cells[within].T)]
        judged = Visible.of(scene.view, scene.shape, scene.voxel).judged
        found.append(Scores.of(scene.occupied, occupied.reshape(scene.shape), judged))
    assert Scores.mean(found).iou >= 0.57
