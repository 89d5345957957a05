"""The table of completion: made by completion's own functions, once, and read from its CSV."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from ocnf_model.completion.train import completion_settings
from ocnf_model.tables import completion
from ocnf_model.tables.plan import TablePlan

SCORES = {"ours": [(0.5, 0.75, 0.5), (0.25, 0.5, 0.75), (0.75, 1.0, 0.25)],
          "extrusion": [(0.125, 0.5, 0.25), (0.25, 0.25, 0.5), (0.5, 0.75, 0.125)],
          "visible band": [(0.1, 0.1, 0.1)] * 3}


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What was called; a run and an evaluation of three frames take its place."""
    called = []

    def train(data: str, out: Path, *, settings: Path, **_: Any) -> None:
        called.append(f"train {yaml.safe_load(settings.read_text())['stages'][0]['epochs']}")
        out.mkdir(parents=True)
        (out / "threshold.json").write_text("{}")

    def evaluate(run: str, data: str, *, out: Path, **_: Any) -> None:
        assert (Path(run) / "threshold.json").is_file()
        called.append("evaluate")
        out.mkdir(parents=True)
        lines = [f"fold_1/scene/{n},{method},{iou},{precision},{recall},0.1"
                 for method, rows in SCORES.items() for n, (iou, precision, recall) in enumerate(rows)]
        head = "frame,method,iou,precision,recall,seconds"
        (out / "frames.csv").write_text("\n".join([head, *lines]) + "\n")

    monkeypatch.setattr(completion, "run_completion_training", train)
    monkeypatch.setattr(completion, "run_completion_evaluation", evaluate)
    monkeypatch.setattr(completion, "list_frames", lambda _, split: [
        SimpleNamespace(name=f"{split}/scene/{n}") for n in range(3)])
    return called


def test_scores_are_means_over_frames_beside_the_papers(
        calls: list[str], make: Callable[..., TablePlan], tmp_path: Path) -> None:
    out = tmp_path / "out"
    plan = make("completion", out, voxlets=tmp_path, epochs=[2])
    assert [step.name for step in plan.left] == [
        "train completion", "evaluate completion", "write completion"]
    assert calls == ["train 2", "evaluate"]
    with (out / "tables/completion.csv").open(newline="") as file:
        rows = {row["Method"]: row for row in csv.DictReader(file)}
    ours = rows["Ours"]
    assert [float(ours[name]) for name in ("IoU", "Precision", "Recall")] == pytest.approx([0.5, 0.75, 0.5])
    assert [ours[f"{name} paper"] for name in ("IoU", "Precision", "Recall")] == ["0.65", "0.834", "0.756"]
    assert float(rows["Zheng et al.*"]["IoU"]) == pytest.approx(0.875 / 3)
    assert rows["Voxlets et al."]["IoU"] == rows["Voxlets et al.*"]["IoU"] == ""  # no forest was fitted here
    text = (out / "tables/completion.md").read_text()
    assert "**0.500** / 0.650" in text and "**0.292**" not in text
    assert "| Zheng et al.* to Ours |" in text


def test_what_is_there_is_used_and_other_epochs_are_another_run(
        calls: list[str], make: Callable[..., TablePlan], tmp_path: Path) -> None:
    make("completion", tmp_path / "out", voxlets=tmp_path, epochs=[2])
    again = make("completion", tmp_path / "out", voxlets=tmp_path, epochs=[2])
    assert [step.kind for step in again.left] == ["write"]
    make("completion", tmp_path / "out", voxlets=tmp_path, epochs=None)
    assert calls == ["train 2", "evaluate", f"train {completion_settings().stage(0).epochs}", "evaluate"]
    assert len(list((tmp_path / "out/runs").iterdir())) == 2
