"""`make_tables`: plans, goes through the steps that are left, and writes the tables."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from ocnf_data.errors import OcnfError
from ocnf_data.files.lock import exclusive
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_data.terminal import check_up
from ocnf_model.tables import WEIGHT_MODELS
from ocnf_model.tables.budget import make_budget
from ocnf_model.tables.completion import CompletionGroup
from ocnf_model.tables.groups import SampleGroup, TableGroup
from ocnf_model.tables.plan import TablePlan, megabytes
from ocnf_model.tables.rates import folder_size
from ocnf_model.tables.schema import TABLE_NAMES, Pipeline, TableSpec, load_table
from ocnf_model.tables.steps import Step, StepKind
from ocnf_model.tables.write import to_latex, to_markdown, to_table_csv
from ocnf_model.training.settings import TrainSettings

MARK = "ocnf-tables.json"
"""File that tells a folder of tables from others."""
LOG = "steps.jsonl"
"""What was done: a line a step, with the time and size that were planned and those that it took."""
_FULL = 1.5  # an estimate may be off by this factor
_FILES = (StepKind.WRITE, StepKind.CHOOSE_WEIGHT, StepKind.TIME, StepKind.DRAW)  # others make folders
_NEEDS = {Pipeline.SCANS: "it needs scans: give their folder with --scans DIR",
          Pipeline.COMPLETION: "it needs the Voxlets data: give its folder with --voxlets DIR"}


def make_tables(
    name: str, root: str | Path, out: str | Path, *, meshes: int | None = None, test: int | None = None,
    settings: TrainSettings | None = None, resolutions: Sequence[int] | None = None,
    epochs: Sequence[int] | None = None, hours: float | None = None, categories: Sequence[str] | None = None,
    stand_ins: Mapping[str, str] | None = None, weight_models: int = WEIGHT_MODELS, device: str = "auto",
    jobs: int = 1, scans: str | Path | None = None, voxlets: str | Path | None = None, dry_run: bool = False,
    up: str = "z", console: Console | None = None,
) -> TablePlan:
    """Make a table of the paper, or all, in a folder; what is there already is used.

    Args:
        name: one of `TABLE_NAMES`, or `all`.
        root: folder of the meshes, `ROOT/category/train|test/*.off` as in ModelNet.
        out: folder of everything that is made; a new one, or one that this function made.
        meshes: meshes to train a network on, over all categories; None: the paper's 200 of each.
        test: meshes of each category to test on; None: the paper's 20.
        settings: of training, but for input and encoding; None: the paper's.
        resolutions: level by level; None: the paper's, as many as the settings have levels.
        epochs: of each level; None: those of the settings.
        categories: folders of the root; None: the paper's nine where the root has them, else all.
        stand_ins: folders of the root that are taken for categories of the paper.
        weight_models: validation models that TV-L1's weight is chosen on.
        hours: training time of each network, in the place of epochs; they are counted by measured rates.
        device: where networks are trained and run: auto, cpu, cuda, ...
        jobs: worker processes of generation.
        scans: folder of scans, for the table of the Kinect; its `meshes` are sets of frames.
        voxlets: folder of the Voxlets data, for the table of completion; of the budget only `epochs` counts.
        up: which axis of the meshes points up in figures: y or z.
        dry_run: measure and print the plan, and do none of it.
        console: where the plan, the progress and the tables' paths are printed.

    Returns:
        The plan, as it was before anything was done.

    Raises:
        OcnfError: no such table, a budget too small, a category that is missing, a folder of something else,
            a full disk, ...
    """
    console = console or Console(stderr=True, emoji=False)
    out = Path(out)
    tables, notes = _wanted(name, {Pipeline.SCANS: scans, Pipeline.COMPLETION: voxlets})
    if epochs is not None and hours is not None:
        raise OcnfError("epochs and hours are two budgets for the same thing", field="--hours",
                        found=f"{hours:g} and --epochs", fix="give one of them")
    check_up(up)
    if all(table.pipeline in _NEEDS for table in tables):
        for option, given in (("--categories", categories), ("--stand-in", stand_ins)):
            if given:
                raise OcnfError("it would have no effect: the table is not made from categories of meshes",
                                field=option, found=", ".join(given), expected=f"no {option} for {name}")
    by_root: dict[Path, list[TableSpec]] = {}
    for table in tables:
        if table.pipeline is Pipeline.COMPLETION:
            continue
        place = scans if table.pipeline is Pipeline.SCANS and scans is not None else root
        by_root.setdefault(Path(place), []).append(table)
    budgets = {place: make_budget(
        place, specs, meshes=meshes, test=test, settings=settings, resolutions=resolutions, epochs=epochs,
        categories=None if specs[0].pipeline is Pipeline.SCANS else categories,
        stand_ins=None if specs[0].pipeline is Pipeline.SCANS else stand_ins,
        weight_models=weight_models) for place, specs in by_root.items()}
    store = Store(out)
    _refuse_others(store)
    with exclusive(store):
        if not store.exists(MARK):
            store.put_bytes(MARK, canonical_json({"schema": 1, "kind": "tables"}))
        groups: list[TableGroup] = [
            SampleGroup(by_root[place], place, out, budget, device, jobs, console, hours=hours,
                        measure=dry_run, up=up) for place, budget in budgets.items()]
        groups += [CompletionGroup(table, Path(voxlets), out, epochs, device, console)
                   for table in tables if table.pipeline is Pipeline.COMPLETION and voxlets is not None]
        plan = TablePlan([step for group in groups for step in group.steps],
                         [step for group in groups for step in group.left],
                         {name: one for group in groups for name, one in group.estimates.items()}, notes)
        for line in plan.lines():
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        if not dry_run:
            _check_space(plan, out)
            for group in groups:
                for step in group.left:
                    _do(step, group, out, console)
        for note in notes:
            console.print(f"note: {note}", highlight=False, markup=False, soft_wrap=True)
    return plan


def _wanted(name: str, given: Mapping[Pipeline, object]) -> tuple[list[TableSpec], list[str]]:
    """The tables of a name, and a sentence for each that cannot be made.

    Args:
        name: of a table, or `all`.
        given: the folders that some pipelines need, or None.
    """
    tables = [load_table(one) for one in (TABLE_NAMES if name == "all" else [name])]
    reasons = {table.name: _NEEDS[table.pipeline] for table in tables
               if table.pipeline in given and given[table.pipeline] is None}
    if reasons and name != "all":
        raise OcnfError(f"the table cannot be made: {reasons[name]}", code="missing", field="NAME",
                        found=name)
    return ([table for table in tables if table.name not in reasons],
            [f"the table {table} is not made: {reason}" for table, reason in reasons.items()])


def _refuse_others(store: Store) -> None:
    if store.exists(MARK):
        return
    strangers = [name for name in store.list() if name != ".lock"]
    if strangers:
        raise OcnfError("the folder is not empty, and holds no tables", code="occupied", where=store.url,
                        found=strangers[0], fix="name a new folder: nothing is overwritten")


def _check_space(plan: TablePlan, out: Path) -> None:
    needed, free = sum(one.size for one in plan.estimates.values()), shutil.disk_usage(out).free
    if needed > _FULL * free:
        raise OcnfError("the disk is too small for what is planned", code="disk_full", where=out,
                        found=f"{megabytes(free)} free", expected=f"about {megabytes(needed)}",
                        fix="free some space, or plan for less: nothing was begun")


def _do(step: Step, group: TableGroup, out: Path, console: Console) -> None:
    estimate = group.estimates.get(step.name)
    console.print(f"[bold]{escape(step.name)}[/]", highlight=False)
    begin = time.perf_counter()
    if step.table is not None:
        _write(step.table, group, out, [])
        console.print(f"{out / 'tables' / step.table.name}.md, .csv, .tex", highlight=False, soft_wrap=True)
    else:
        group.do(step)
    made = out / step.target
    size = made.stat().st_size if step.kind in _FILES else folder_size(made.parent)
    line = {"step": step.name, "seconds": round(time.perf_counter() - begin, 1), "bytes": size}
    if estimate is not None:
        line |= {"planned_seconds": round(estimate.seconds, 1), "planned_bytes": round(estimate.size)}
    store = Store(out)
    before = store.read_bytes(LOG) if store.exists(LOG) else b""
    store.put_bytes(LOG, before + json.dumps(line).encode() + b"\n")
    if step.kind in (StepKind.BASELINES, StepKind.EVALUATE, StepKind.TIME):
        _write_so_far(group, out)


def _write_so_far(group: TableGroup, out: Path) -> None:
    """Write the tables that are not finished with the figures that there are."""
    for step in group.left:
        if step.table is not None:
            names = {one.name for one in group.steps_of(step.table)} - {step.name}
            left = [one for one in group.left if one.name in names and not group.is_done(one)]
            if left:
                _write(step.table, group, out, left)


def _write(table: TableSpec, group: TableGroup, out: Path, left: Sequence[Step]) -> None:
    figures, above = group.content(table)
    if left:
        above = [f"Not finished: what is left begins with `{left[0].name}`.", *above]
    files = {"csv": to_table_csv(table, figures.cells), "tex": to_latex(table, figures.cells, above),
             "md": to_markdown(table, figures.cells, list(figures.readings()), above)}
    for ending, text in files.items():
        Store(out / "tables").put_bytes(f"{table.name}.{ending}", text.encode())
