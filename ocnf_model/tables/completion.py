"""The table of completion from one view: the completion network trained, and all methods measured.

    OUT/settings/completion-KEY.yaml      settings of training
    OUT/runs/completion-KEY/              the run, as `ocnf-model complete train` makes it
    OUT/networks/completion-KEY/          every frame's figures, as `ocnf-model complete evaluate` writes them
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_model.completion.evaluate import run_completion_evaluation
from ocnf_model.completion.predict import THRESHOLD
from ocnf_model.completion.train import completion_settings, run_completion_training
from ocnf_model.completion.voxlets import list_frames
from ocnf_model.tables.cells import TableFigures
from ocnf_model.tables.differences import machine
from ocnf_model.tables.rates import Estimate
from ocnf_model.tables.samples import read_lines
from ocnf_model.tables.schema import Line, TableSpec
from ocnf_model.tables.steps import Step, StepKind, short_key

_SYNTHETIC = 40  # tabletops that training begins with


class CompletionGroup:
    """The table of completion.

    Args:
        table: the table.
        data: the folder of the Voxlets data.
        out: the folder of everything that is made.
        epochs: of each level, the last number for later ones; None for completion's own.
        device: where the network is trained and run.
        console: where progress is shown.
    """

    def __init__(self, table: TableSpec, data: Path, out: Path, epochs: Sequence[int] | None, device: str,
                 console: Console) -> None:
        self._data, self._out, self._device, self._console = data, out, device, console
        settings = completion_settings()
        if epochs is not None:
            stages = [{**settings.stage(level).model_dump(mode="json"),
                       "epochs": epochs[min(level, len(epochs) - 1)]} for level in range(settings.levels)]
            settings = completion_settings({"stages": stages})
        self._settings = settings
        self._frames = {split: [frame.name for frame in list_frames(str(data), split)]
                        for split in ("train", "test")}
        self._key = short_key([settings.decisive(), self._frames])
        name = f"completion-{self._key}"
        self.steps: Sequence[Step] = [
            Step(StepKind.TRAIN, "completion", f"runs/{name}/{THRESHOLD}"),
            Step(StepKind.EVALUATE, "completion", f"networks/{name}/frames.csv"),
            Step(StepKind.WRITE, table.name, f"tables/{table.name}.md", table=table)]
        self.left: Sequence[Step] = [step for step in self.steps if not self.is_done(step)]
        self.estimates: Mapping[str, Estimate] = {}

    def is_done(self, step: Step) -> bool:
        """Whether what a step makes is there: each makes its last file at the end."""
        return step.table is None and (self._out / step.target).is_file()

    def do(self, step: Step) -> None:
        """Do a step that writes no table."""
        folder = (self._out / step.target).parent
        if step.kind is StepKind.TRAIN:
            place, name = self._out / "settings", f"{folder.name}.yaml"
            Store(place).put_bytes(name, canonical_json(self._settings.to_dict(), indent=1))
            run_completion_training(str(self._data), folder, settings=place / name, synthetic=_SYNTHETIC,
                                    device=self._device, console=self._console)
        else:
            run_completion_evaluation(str(self._out / "runs" / folder.name), str(self._data), out=folder,
                                      device=self._device, console=Console(quiet=True))

    def steps_of(self, table: TableSpec) -> Sequence[Step]:
        """The steps of the table."""
        return self.steps

    def content(self, table: TableSpec) -> tuple[TableFigures, list[str]]:
        """The figures of the table, and the sentences above it."""
        epochs = ", ".join(str(self._settings.stage(level).epochs) for level in range(self._settings.levels))
        above = [table.protocol,
                 f"Here: {len(self._frames['train'])} frames for training and validation and "
                 f"{len(self._frames['test'])} for testing, after {_SYNTHETIC} synthetic tabletops; {epochs} "
                 f"epochs; {machine(self._device)}.", *table.remarks]
        path = self._out / self.steps[1].target
        return TableFigures(table, partial(_frame_figures, path)), above


def _frame_figures(path: Path, row: Line, column: Line) -> dict[str, float]:
    """The figure of each frame."""
    if row.completion is None or column.score is None or not path.is_file():
        return {}
    return {line["frame"]: float(line[column.score]) for line in read_lines(path)
            if line["method"] == row.completion}
