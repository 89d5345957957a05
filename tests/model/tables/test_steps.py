"""Folders' names: equal exactly when the content is, so nothing is overwritten and nothing is made twice."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_model.tables import rates
from ocnf_model.tables.budget import Budget, listed, make_budget
from ocnf_model.tables.execute import Executor
from ocnf_model.tables.plan import TablePlan
from ocnf_model.tables.schema import TABLE_NAMES, TableSpec, load_table
from ocnf_model.tables.steps import Layout, StepKind, plan_steps
from ocnf_model.training.settings import TrainSettings

TABLES = [table for table in map(load_table, TABLE_NAMES) if table.pipeline == "samples"]


@pytest.fixture
def budget(root: Path, settings: TrainSettings) -> Budget:
    return make_budget(root, TABLES, meshes=6, test=1, settings=settings, resolutions=[32], epochs=[1],
                       stand_ins={"desk": "table"})


def layout(budget: Budget, root: Path, out: Path = Path("out")) -> Layout:
    entries = listed(budget, root)
    return Layout(out, budget, entries,
                  {str(entry.path): (root / str(entry.path)).stat().st_size for entry in entries})


def targets(tables: list[TableSpec], one: Layout, kind: str) -> list[str]:
    return [step.target for step in plan_steps(tables, one) if step.kind == kind]


def test_all_tables_share_what_they_can(budget: Budget, root: Path) -> None:
    steps = plan_steps(TABLES, layout(budget, root))
    counts = {kind: sum(step.kind == kind for step in steps) for kind in ("generate", "train", "evaluate")}
    assert counts == {"generate": 7, "train": 11, "evaluate": 11}
    assert len({step.name for step in steps}) == len({step.target for step in steps}) == len(steps)
    for table in TABLES:  # one alone takes no other steps than beside the others
        assert all(step in steps for step in plan_steps([table], layout(budget, root)))


def test_what_a_step_needs_is_made_before_it(budget: Budget, root: Path) -> None:
    steps = [step.name for step in plan_steps(TABLES, layout(budget, root))]
    for step in plan_steps(TABLES, layout(budget, root)):
        before = {"choose-weight": "generate", "baselines": "choose-weight", "train": "generate",
                  "evaluate": "train", "draw": "train", "time": "generate"}.get(step.kind)
        if before is not None:
            subject = step.network.name if before == "train" else step.variant
            assert steps.index(f"{before} {subject}") < steps.index(step.name)
        else:
            assert step.kind in ("generate", "write")


def test_other_epochs_are_other_runs_of_the_same_data(budget: Budget, root: Path) -> None:
    ours, theirs = layout(budget, root), layout(budget.with_epochs([2]), root)
    assert targets(TABLES, ours, "generate") == targets(TABLES, theirs, "generate")
    assert not set(targets(TABLES, ours, "train")) & set(targets(TABLES, theirs, "train"))


def test_what_a_weight_chosen_on_more_models_goes_into_is_made_again(budget: Budget, root: Path) -> None:
    ours, theirs = layout(budget, root), layout(replace(budget, weight_models=7), root)
    for kind in StepKind:
        shared = set(targets(TABLES, ours, kind)) & set(targets(TABLES, theirs, kind))
        again = kind in (StepKind.CHOOSE_WEIGHT, StepKind.BASELINES, StepKind.DRAW)
        assert not shared if again else shared == set(targets(TABLES, ours, kind)), kind


def test_figures_with_another_axis_up_are_drawn_again(budget: Budget, root: Path) -> None:
    ours, theirs = layout(budget, root), layout(budget, root)
    theirs.up = "y"
    for kind in StepKind:
        shared = set(targets(TABLES, ours, kind)) & set(targets(TABLES, theirs, kind))
        assert not shared if kind is StepKind.DRAW else shared == set(targets(TABLES, ours, kind)), kind


def test_other_meshes_of_the_same_names_are_other_data(budget: Budget, root: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(root, tmp_path / "meshes")
    ours = targets(TABLES, layout(budget, root), "train")
    assert targets(TABLES, layout(budget, copy), "train") == ours
    with (copy / "chair/train/chair_0001.off").open("a") as file:
        file.write("\n")
    assert not set(ours) & set(targets(TABLES, layout(budget, copy), "train"))
    fewer = layout(replace(budget, train=1), root)
    assert not set(ours) & set(targets(TABLES, fewer, "train"))


def test_splits_share_no_mesh_and_validation_stays_as_training_grows(budget: Budget, root: Path) -> None:
    found = {(entry.split, entry.path) for entry in listed(budget, root)}
    fewer = {(entry.split, entry.path) for entry in listed(replace(budget, train=1), root)}
    assert len({path for _, path in found}) == len(found) == 3 * (2 + 1 + 1)
    assert fewer < found and sum(split == "train" for split, _ in fewer) == 3


def test_a_run_that_was_stopped_is_no_finished_one(
        made: tuple[Path, dict[str, TablePlan]], make: Callable[..., TablePlan], tmp_path: Path) -> None:
    out = shutil.copytree(made[0], tmp_path / "out")
    run, = (out / "runs").glob("*without*")
    curves = (run / "curves.csv").read_text()
    (run / "curves.csv").write_text(curves.splitlines()[0] + "\n")  # as when killed before the line was there
    assert [step.name for step in make("unseen", out).left] == [
        "train histogram-v4_n02-without-airplane-desk", "write unseen"]
    assert (run / "curves.csv").read_text() == curves
    assert json.loads((out / "steps.jsonl").read_text().splitlines()[-1])["step"] == "write unseen"


@pytest.mark.parametrize("damaged", [b'{"schema":', b'{"schema": 99}'])
def test_a_damaged_plan_of_a_data_set_is_said_with_what_to_do(
        budget: Budget, root: Path, tmp_path: Path, damaged: bytes) -> None:
    one = layout(budget, root, tmp_path)
    step = plan_steps(TABLES, one)[0]
    assert step.kind is StepKind.GENERATE
    folder = (tmp_path / step.target).parent
    folder.mkdir(parents=True)
    (folder / "plan.json").write_bytes(damaged)
    with pytest.raises(OcnfError, match=r"plan\.json: .*, and run the same command again") as caught:
        Executor(one, root, "cpu", 1, Console(quiet=True)).do(step)
    assert f"or delete {folder}," in str(caught.value.fix)


@pytest.mark.parametrize("damaged", [b"{", b"[]", b"[" * 100_000, b"\xff"])
def test_damaged_rates_are_measured_again(budget: Budget, root: Path, tmp_path: Path, damaged: bytes,
                                          monkeypatch: pytest.MonkeyPatch) -> None:
    measured = rates.Rates(generate={"fixed": 1.0}, encodings=4, members={}, train_sample=(1.0,),
                           train_validation=(1.0,), train_fixed=1.0, run_bytes=1.0, weigh=1.0, baselines=1.0,
                           evaluate=1.0, time=1.0)
    monkeypatch.setattr(rates, "_measure", lambda *_: measured)
    one = layout(budget, root, tmp_path)
    (tmp_path / "rates.json").write_bytes(damaged)
    assert rates.read_rates(one, "cpu") is None
    assert rates.calibrate(one, root, "cpu", Console(quiet=True), TABLES) == measured
    assert rates.read_rates(one, "cpu") == measured
