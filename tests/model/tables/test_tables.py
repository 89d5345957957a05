"""Tables from meshes: the plan is what is done, a stop costs nothing, and every figure can be recomputed."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import mean

import pytest
import yaml

from ocnf_model.tables.execute import Executor
from ocnf_model.tables.plan import TablePlan
from ocnf_model.tables.schema import load_table
from ocnf_model.tables.steps import Step
from ocnf_model.training.settings import TrainSettings

CELL = re.compile(r"\s*(?:\$(?:\\textbf\{)?([\d.]+)\}?\$|--) \(([\d.]+)\)\s*")
Make = Callable[..., TablePlan]
Made = tuple[Path, dict[str, TablePlan]]


def log(out: Path) -> list[str]:
    """Names of the steps that were done, in order."""
    return [json.loads(line)["step"] for line in (out / "steps.jsonl").read_text().splitlines()]


def table_csv(out: Path, name: str) -> list[dict[str, str]]:
    with (out / "tables" / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def errors(folder: Path, method: str, category: str | None = None) -> list[float]:
    """The models' MAD, straight from what evaluation wrote."""
    with (folder / "models.csv").open(newline="") as file:
        return [float(line["mad_mm"]) for line in csv.DictReader(file)
                if line["method"] == method and category in (None, line["category"])]


def test_the_steps_done_are_those_planned(made: Made) -> None:
    out, plans = made
    planned = [step.name for name in ("encodings", "unseen") for step in plans[name].left]
    assert log(out)[: len(planned)] == planned
    assert planned[0] == "generate v4_n02" and "write encodings" in planned
    assert len(list((out / "runs").iterdir())) == 5


def test_another_table_makes_only_what_is_its_own(made: Made) -> None:
    _, plans = made
    assert [step.name for step in plans["unseen"].left] == [
        "train histogram-v4_n02-without-airplane-desk",
        "evaluate histogram-v4_n02-without-airplane-desk", "write unseen"]


def test_a_table_that_is_there_is_only_written_again(made: Made, make: Make) -> None:
    out, _ = made
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert [step.name for step in make("unseen", out).left] == ["write unseen"]
    changed = {path.relative_to(out).parts[0] for path, at in before.items() if path.stat().st_mtime_ns != at}
    assert changed == {"tables", "steps.jsonl"}


def test_a_dry_run_measures_and_makes_nothing_and_then_its_steps_are_done(
        planned: tuple[Path, TablePlan], make: Make, tmp_path: Path) -> None:
    out, plan = tmp_path / "out", planned[1]
    assert {path.name for path in planned[0].iterdir()} == {"ocnf-tables.json", "rates.json"}
    assert all(plan.estimates[step.name].seconds > 0 for step in plan.left if step.kind != "write")
    shutil.copytree(planned[0], out)
    again = make("runtime", out, dry_run=True, epochs=[3])  # by the same rates
    name = "train histogram-v4_n02"
    assert again.estimates[name].seconds > plan.estimates[name].seconds
    done = make("runtime", out)
    assert [step.name for step in done.left] == [step.name for step in plan.left] == log(out)
    size = sum(path.stat().st_size for path in (out / "data").rglob("*") if path.is_file())
    assert 2 / 3 < plan.estimates["generate v4_n02"].size / size < 3 / 2
    line = table_csv(out, "runtime")[0]
    assert 0 < float(line["VolFus"]) < 60 and 0 < float(line["Ours"]) < 60


def test_the_figures_are_means_over_the_models(made: Made) -> None:
    out, _ = made
    row = table_csv(out, "encodings")[0]
    networks = {"Occ": "occupancy-", "TDF + Occ": "tdf_occupancy-", "TSDF": "tsdf-",
                "TSDF Hist": "histogram-"}
    for column, prefix in networks.items():
        folder, = (path for path in (out / "networks").iterdir()
                   if path.name.startswith(prefix) and "without" not in path.name)
        assert float(row[column]) == pytest.approx(mean(errors(folder, "Ours")), rel=1e-12)
        assert float(row[f"{column} low"]) <= float(row[column]) <= float(row[f"{column} high"])
        assert row[f"{column} models"] == "6"
    baselines, = (out / "baselines").iterdir()
    for method in ("VolFus", "TV-L1"):
        assert float(row[method]) == pytest.approx(mean(errors(baselines, method)), rel=1e-12)
    assert [row["TSDF Hist paper"], row["VolFus paper"]] == ["1.715", "4.136"]
    assert table_csv(out, "encodings")[2]["Occ"] == ""  # the budget has no such level


def test_a_category_of_the_paper_may_be_another_folder(made: Made) -> None:
    out, _ = made
    rows = {row[""]: row for row in table_csv(out, "unseen")}
    without, = (path for path in (out / "networks").iterdir() if "without" in path.name)
    assert float(rows["desk 64³"]["Unseen"]) == pytest.approx(mean(errors(without, "Ours", "table")))
    assert rows["desk 64³"]["Unseen models"] == "2"
    run, = (path for path in (out / "runs").iterdir() if "without" in path.name)
    assert json.loads((run / "settings.json").read_bytes())["settings"]["categories"] == ["chair"]
    text = (out / "tables" / "unseen.md").read_text()
    assert "The folder table takes the place of the paper's category desk." in text


def grid(text: str) -> list[list[str]]:
    """The first table of a Markdown page, without its rule."""
    lines = [line for line in text.split("\n\n")[3].splitlines() if not line.startswith("| ---")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize("name", ["encodings", "unseen"])
def test_markdown_and_latex_say_what_the_csv_says(made: Made, name: str) -> None:
    out, _ = made
    table, rows = load_table(name), table_csv(out, name)
    head, *body = grid((out / "tables" / f"{name}.md").read_text())
    assert head[1:] == [column.name for column in table.columns]
    latex = (out / "tables" / f"{name}.tex").read_text()
    lines = [line for line in latex.splitlines() if r"\\" in line and "^3$" in line]
    assert len(body) == len(lines) == len(rows)
    for row, cells, line in zip(rows, body, lines, strict=True):
        assert cells[0] == row[table.corner]
        in_latex = line.split(r"\\")[0].split("&")[-len(table.columns):]
        for column, cell, tex in zip(head[1:], cells[1:], in_latex, strict=True):
            ours, paper = (part.strip("* ") for part in cell.split("/"))
            number, bracket = CELL.fullmatch(tex).groups()
            assert float(paper) == float(bracket) == float(row[f"{column} paper"])
            if row[column]:
                assert float(ours) == float(number) == pytest.approx(float(row[column]), abs=5.1e-4)
            else:
                assert (ours, number) == ("–", None)
    bold = [line.count("**") for line in (out / "tables" / f"{name}.md").read_text().splitlines()
            if line.startswith("| ") and "64³ |" in line and " / " in line]
    assert set(bold) == {2}  # one figure a row
    n_columns = len(re.search(r"\\begin\{tabular\}\{(\w+)\}", latex)[1])
    assert n_columns == len(table.columns) + (2 if name == "unseen" else 1)


def test_a_killed_command_goes_on_and_gives_the_same_table(
        made: Made, root: Path, make: Make, settings: TrainSettings, tmp_path: Path) -> None:
    whole, _ = made
    out = tmp_path / "out"
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(settings.to_dict()))
    process = subprocess.Popen(
        [sys.executable, "-m", "ocnf_model.cli", "tables", "encodings", "--data", str(root),
         "--out", str(out), "--meshes", "6", "--test", "2", "--resolutions", "32", "--epochs", "1",
         "--settings", str(tmp_path / "tiny.yaml"), "--stand-in", "desk=table", "--weight-models", "1",
         "--device", "cpu"],
        env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    end = time.monotonic() + 200
    while not list(out.glob("runs/*/settings.json")) and process.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert process.returncode == -signal.SIGKILL, process.stderr.read().decode()
    done = log(out)
    assert done[0] == "generate v4_n02" and "write encodings" not in done
    rest = [step.name for step in make("encodings", out).left]
    assert done + rest == log(out)
    assert (out / "tables/encodings.csv").read_bytes() == (whole / "tables/encodings.csv").read_bytes()
    assert not math.isnan(float(table_csv(out, "encodings")[0]["TSDF Hist"]))


def test_a_table_is_there_as_far_as_it_is_known(made: Made, make: Make, tmp_path: Path,
                                                monkeypatch: pytest.MonkeyPatch) -> None:
    out = shutil.copytree(made[0], tmp_path / "out")
    for folder in [*(out / "networks").glob("*without*"), *(out / "baselines").iterdir()]:
        shutil.rmtree(folder)
    whole = Executor.do

    def stopped(self: Executor, step: Step) -> None:
        if step.kind == "evaluate":
            raise KeyboardInterrupt
        whole(self, step)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Executor, "do", stopped)
        make("unseen", out)
    text = (out / "tables/unseen.md").read_text()
    assert "Not finished: what is left begins with `evaluate histogram-v4_n02-without-airplane-desk`." in text
    row = table_csv(out, "unseen")[0]
    assert row["Unseen"] == "" and float(row["Seen"]) > 0 and float(row["VolFus"]) > 0
    make("unseen", out)
    assert "Not finished" not in (out / "tables/unseen.md").read_text()
    for ending in ("csv", "md", "tex"):
        name = f"tables/unseen.{ending}"
        assert (out / name).read_text() == (made[0] / name).read_text()
