"""Bad input is a sentence, and nothing that was done before is lost."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_model.tables.budget import make_budget
from ocnf_model.tables.command import tables_command
from ocnf_model.tables.plan import TablePlan
from ocnf_model.tables.rates import epochs_within
from ocnf_model.tables.run import make_tables
from ocnf_model.training.settings import TrainSettings, read_settings

Make = Callable[..., TablePlan]


@pytest.mark.parametrize(("name", "changes", "said"), [
    ("unseen", {"stand_ins": {}}, "needs a category .* expected desk. .*--stand-in"),
    ("unseen", {"stand_ins": {"desk": "sofa"}}, "the root lacks a category; .*expected sofa"),
    ("views", {"categories": ["airplane", "mug"]}, "the root lacks a category; .*expected mug"),
    ("views", {"meshes": 2}, "--meshes: the budget is too small for one epoch.*found 2, expected at least 3"),
    ("views", {"epochs": [0]}, "--epochs: the budget is too small for one epoch"),
    ("views", {"epochs": [1], "hours": 1.0}, "--hours: epochs and hours are two budgets"),
    ("views", {"resolutions": [32, 64]}, "the levels do not fit the resolutions; found 1, expected 2, for"),
    ("views", {"resolutions": [48]}, r"resolutions\[0\]: .* found 48, expected a multiple of 32"),
    ("views", {"stand_ins": {"dsk": "table"}}, "--stand-in: not among the paper's categories; found dsk"),
    ("kinect", {}, "the table cannot be made: it needs scans: give their folder with --scans DIR"),
    ("kinect", {"scans": Path("scans"), "stand_ins": {"desk": "table"}},
     "--stand-in: it would have no effect: .*; found desk, expected no --stand-in for kinect"),
    ("completion", {"voxlets": Path("voxlets"), "categories": ["airplane"]},
     "--categories: it would have no effect: .*; found airplane, expected no --categories for completion"),
    ("completion", {}, "the table cannot be made: it needs the Voxlets data: .* --voxlets DIR"),
    ("views", {"up": "x"}, "--up: not an axis that can point up; found x, expected y or z"),
    ("tabel", {}, "no such table; found tabel"),
])
def test_what_cannot_be_made_is_refused_before_anything_is_written(
        make: Make, tmp_path: Path, name: str, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(OcnfError, match=said):
        make(name, tmp_path / "out", **changes)
    assert not (tmp_path / "out").exists()


def test_a_scan_with_too_few_frames_is_refused_before_anything_is_made(
        make: Make, scan: Path, tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans/two_solids").symlink_to(scan)
    with pytest.raises(OcnfError, match=r"configurations\.train: too few frames; .* expected at least 20"):
        make("kinect", tmp_path / "out", scans=tmp_path / "scans", meshes=1)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["ocnf-tables.json"]


def test_a_folder_of_something_else_is_left_alone(make: Make, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OcnfError, match=r"holds no tables; found notes\.txt"):
        make("views", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_run_of_something_else_in_a_networks_place_is_refused(
        made: tuple[Path, dict[str, TablePlan]], make: Make, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(made[0], out)
    ours, = (out / "runs").glob("histogram-v4_n02-without*")
    other, = (out / "runs").glob("tsdf-*")
    shutil.rmtree(ours)
    shutil.copytree(other, ours)
    (ours / "curves.csv").unlink()  # unfinished, so that it would be gone on with
    before = {path: path.read_bytes() for path in ours.iterdir() if path.is_file()}
    with pytest.raises(OcnfError, match="the run was begun with other settings"):
        make("unseen", out)
    assert {path: path.read_bytes() for path in ours.iterdir() if path.is_file()} == before


def test_a_full_disk_stops_with_a_sentence_and_the_same_call_goes_on(
        made: tuple[Path, dict[str, TablePlan]], make: Make, tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    shutil.copytree(made[0], out)
    evaluation, = (out / "networks").glob("*without*")
    table = (out / "tables/unseen.csv").read_bytes()
    shutil.rmtree(evaluation)
    whole = Store.put_bytes

    def full(self: Store, name: str, data: bytes) -> None:
        if name == "models.csv":
            raise OcnfError("the disk is full", code="disk_full", where=self.where(name))
        whole(self, name, data)

    with monkeypatch.context() as patched:
        patched.setattr(Store, "put_bytes", full)
        with pytest.raises(OcnfError, match="the disk is full"):
            make("unseen", out)
    assert [step.kind for step in make("unseen", out).left] == ["evaluate", "write"]
    assert (out / "tables/unseen.csv").read_bytes() == table


def test_a_plan_that_does_not_fit_the_disk_is_refused(
        planned: tuple[Path, TablePlan], make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(planned[0], tmp_path / "out")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 10, 1000))
    with pytest.raises(OcnfError, match=r"the disk is too small .* found 0\.0 MB free"):
        make("runtime", tmp_path / "out")
    assert not (tmp_path / "out/data").exists()



@given(st.lists(st.floats(0.01, 1e4), min_size=1, max_size=3), st.floats(0, 100), st.floats(0.01, 100))
def test_hours_hold_the_epochs_in_the_papers_proportions(
        seconds: list[float], fixed: float, hours: float) -> None:
    paper = [50, 25, 25][: len(seconds)]
    try:
        epochs = epochs_within(hours, seconds, fixed, paper)
    except OcnfError as error:
        assert error.code == "budget"
        whole = sum(n * one for n, one in zip(paper, seconds, strict=True))
        assert (3600 * hours - fixed) / whole * min(paper) < 1
        return
    assert min(epochs) >= 1
    assert fixed + sum(n * one for n, one in zip(epochs, seconds, strict=True)) <= 3600 * hours * (1 + 1e-9)
    assert all(abs(epochs[0] - 2 * later) <= 2 for later in epochs[1:])


def test_the_command_line_has_the_defaults_of_the_function() -> None:
    asked, given = (signature(function).parameters for function in (tables_command, make_tables))
    for name in ("weight_models", "device", "jobs", "up", "dry_run"):
        assert asked[name].default == given[name].default, name


@pytest.mark.parametrize(("fields", "said"), [
    ({"categories": ["airplane"]}, "categories: it would have no effect: the networks of a table"),
    ({"variant": "v4"}, "variant: it would have no effect"),
    ({"encoding": "tsdf"}, "encoding: it would have no effect.*found tsdf, expected histogram"),
    ({"mixture": [{"weight": 1}], "samples_per_epoch": 4}, "mixture: it would have no effect"),
    ({"output": "occupancy"}, "output: tables are of distances")], ids=str)
def test_settings_that_make_no_table(fields, said, make: Make, tmp_path: Path,
                                     settings: TrainSettings) -> None:
    given = read_settings({**settings.model_dump(mode="json", exclude_unset=True), **fields}, "test")
    with pytest.raises(OcnfError, match=said):
        make("views", tmp_path / "out", settings=given)
    assert not (tmp_path / "out").exists()


def test_a_run_to_start_from_says_what_the_networks_are(tmp_path: Path, root: Path) -> None:
    given = read_settings({"start": "pretrained", "levels": 1}, "test")
    budget = make_budget(root, [], meshes=6, settings=given)
    assert (budget.settings.context, budget.settings.level_channels) == (128, ((24, 48, 96),))
    assert (budget.settings.finer, budget.settings.blend) == (1, True)
