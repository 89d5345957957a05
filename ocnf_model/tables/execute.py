"""Doing a step: the same functions that the commands generate, train, choose-weight and evaluate call."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.generation import generate
from ocnf_data.shards.dataset import PLAN
from ocnf_model.checkpoint import open_run
from ocnf_model.devices import pick_device
from ocnf_model.evaluation.methods import Method
from ocnf_model.evaluation.run import evaluate, run_choose_weight
from ocnf_model.tables.steps import Layout, Step, StepKind
from ocnf_model.tables.times import time_encodings
from ocnf_model.training.run import train


class Executor:
    """Does steps, but for the last, which writes a table.

    Args:
        layout: where everything goes.
        root: the folder of the meshes.
        device: where networks are trained and run: auto, cpu, cuda, ...
        jobs: worker processes of generation.
        console: where progress is shown.
        limit: evaluate the first so many models only; None for all.
    """

    def __init__(self, layout: Layout, root: Path, device: str, jobs: int, console: Console,
                 limit: int | None = None) -> None:
        self._layout, self._root, self._device, self._jobs = layout, root, device, jobs
        self._console, self.limit = console, limit
        self._bars = console if console.is_terminal else None

    def do(self, step: Step) -> None:
        """Do a step, or go on with it where it was stopped.

        Raises:
            OcnfError: whatever the command that it stands for refuses.
        """
        out = self._layout.out / step.target
        match step.kind:
            case StepKind.GENERATE:
                self._generate(step, out.parent)
            case StepKind.CHOOSE_WEIGHT:
                run_choose_weight(self._data(step), out=out, n_models=self._layout.budget.weight_models)
            case StepKind.BASELINES:
                found = evaluate(None, self._data(step), methods=[Method.VOLFUS, Method.TVL1],
                                 weights=self._weights(step), limit=self.limit, console=self._bars)
                found.write(out.parent)
            case StepKind.TRAIN:
                assert step.network is not None
                train(self._data(step), out.parent, self._layout.budget.network_settings(step.network),
                      device=self._device, console=self._console)
            case StepKind.EVALUATE:
                self._evaluate(step, out.parent)
            case StepKind.TIME:
                time_encodings(self._data(step), self._root, out, self.limit)
            case StepKind.DRAW:
                self._draw(step, out)
            case _:
                raise AssertionError(step.kind)

    def _generate(self, step: Step, out: Path) -> None:
        assert step.input is not None
        manifest = self._layout.budget.manifest(step.variant, step.input)
        try:
            report = generate(manifest, out, self._root, jobs=self._jobs, progress=self._console.is_terminal)
        except OcnfError as error:
            if error.where != Store(out).where(PLAN):
                raise
            # Nobody has chosen this folder, so another one cannot be named.
            raise error.replaced(fix=f"put back what it was begun with, or delete {out}, and run the same "
                                     "command again: the data set is made anew") from error
        if not report.ok:
            raise OcnfError(f"{report.failed_share:.1%} of the meshes failed; {report.threshold:.1%} may",
                            where=out / "failures.jsonl",
                            fix="look at the reasons there, and take the bad meshes out of the root")

    def _data(self, step: Step) -> str:
        assert step.input is not None
        return str(self._layout.out / "data" / self._layout.data(step.variant, step.input))

    def _weights(self, step: Step) -> Path:
        assert step.input is not None
        data = self._layout.data(step.variant, step.input)
        return self._layout.out / "weights" / f"{self._layout.weighed(data)}.json"

    def _run(self, step: Step) -> Path:
        assert step.network is not None and step.input is not None
        return self._layout.out / "runs" / self._layout.run(step.network, step.input)

    def _evaluate(self, step: Step, out: Path) -> None:
        trained = open_run(self._run(step), self._layout.budget.settings.levels)
        found = evaluate(trained.network.to(pick_device(self._device)), self._data(step),
                         resolutions=trained.resolutions, methods=[Method.OURS], limit=self.limit,
                         console=self._bars)
        found.write(out)

    def _draw(self, step: Step, out: Path) -> None:
        trained = open_run(self._run(step), self._layout.budget.settings.levels)
        found = evaluate(trained.network.to(pick_device(self._device)), self._data(step),
                         resolutions=trained.resolutions, weights=self._weights(step), limit=1, n_figures=1,
                         up=self._layout.up, categories=[step.category], console=self._bars)
        Store(out.parent).put_bytes(out.name, next(iter(found.figures.values())))
