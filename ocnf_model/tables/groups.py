"""Tables that are made by the same steps from the same root."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

from rich.console import Console

from ocnf_data.files.storage_errors import storage_errors
from ocnf_model.tables.budget import PAPER_EPOCHS, Budget, listed
from ocnf_model.tables.cells import TableFigures
from ocnf_model.tables.differences import differences, machine
from ocnf_model.tables.execute import Executor
from ocnf_model.tables.rates import Estimate, Estimator, calibrate, epochs_within, folder_size, read_rates
from ocnf_model.tables.samples import sample_figures
from ocnf_model.tables.schema import TableSpec
from ocnf_model.tables.steps import Layout, Step, plan_steps


class TableGroup(Protocol):
    """What `make_tables` needs of some tables."""

    steps: Sequence[Step]
    """All steps, in order."""
    left: Sequence[Step]
    """Those that were not done at first."""
    estimates: Mapping[str, Estimate]
    """What those that are left take, by name; those that nothing was measured for are missing."""

    def is_done(self, step: Step) -> bool:
        """Whether what a step makes is there, whole."""

    def do(self, step: Step) -> None:
        """Do a step that writes no table."""

    def steps_of(self, table: TableSpec) -> Sequence[Step]:
        """The steps of one of the tables."""

    def content(self, table: TableSpec) -> tuple[TableFigures, list[str]]:
        """The figures of a table, and the sentences above it."""


class SampleGroup:
    """Tables of meshes, or of scans: data sets, networks, evaluations.

    Args:
        tables: the tables.
        root: the folder of the meshes or scans.
        out: the folder of everything that is made.
        budget: what is spent.
        device: where networks are trained and run.
        jobs: worker processes of generation.
        console: where progress is shown.
        hours: training time of each network, in the place of the budget's epochs.
        measure: measure rates where there are none yet.
        up: which axis of the meshes points up in figures: y or z.
    """

    def __init__(self, tables: Sequence[TableSpec], root: Path, out: Path, budget: Budget, device: str,
                 jobs: int, console: Console, *, hours: float | None = None, measure: bool = False,
                 up: str = "z") -> None:
        views = max(spec.views for table in tables for spec in table.inputs.values())
        listed(budget, root, views)  # a scan with too few frames is refused before anything is made
        self._root, self._device = root, device
        layout = _layout(out, budget, root, up)
        rates = read_rates(layout, device)
        if rates is None and (measure or hours is not None):
            rates = calibrate(layout, root, device, console, tables)
        if hours is not None:
            assert rates is not None
            seconds = Estimator(rates, layout, root, jobs).epoch_seconds()
            paper = [PAPER_EPOCHS[min(level, 2)] for level in range(len(seconds))]
            budget = budget.with_epochs(epochs_within(hours, seconds, rates.train_fixed, paper))
            layout = _layout(out, budget, root, up)
        self._layout = layout
        self._executor = Executor(layout, root, device, jobs, console)
        self.steps: Sequence[Step] = plan_steps(tables, layout)
        self.left: Sequence[Step] = [step for step in self.steps if not layout.is_done(step)]
        estimator = None if rates is None else Estimator(rates, layout, root, jobs)
        self.estimates: Mapping[str, Estimate] = {} if estimator is None else {
            step.name: estimator.of(step) for step in self.left}

    def is_done(self, step: Step) -> bool:
        """Whether what a step makes is there, whole."""
        return self._layout.is_done(step)

    def do(self, step: Step) -> None:
        """Do a step that writes no table."""
        self._executor.do(step)

    def steps_of(self, table: TableSpec) -> Sequence[Step]:
        """The steps of one of the tables."""
        return plan_steps([table], self._layout)

    def content(self, table: TableSpec) -> tuple[TableFigures, list[str]]:
        """The figures of a table, and the sentences above it."""
        figures = TableFigures(table, partial(sample_figures, table, self._layout))
        return figures, differences(table, self._layout.budget, listed(self._layout.budget, self._root),
                                    machine(self._device))


def _layout(out: Path, budget: Budget, root: Path, up: str) -> Layout:
    entries = listed(budget, root)
    sizes = {}
    for entry in entries:
        path = root / str(entry.path)
        with storage_errors(path):
            sizes[str(entry.path)] = folder_size(path) if path.is_dir() else path.stat().st_size
    return Layout(out, budget, entries, sizes, up)
