"""What a run shows: a progress bar, TensorBoard curves, and a CSV file with a line an epoch."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ocnf_data.files.storage import Store
from ocnf_model.training.train_state import EpochRow
from ocnf_model.training.validation import Validation, region_scalars

CURVES = "curves.csv"


class Reporter:
    """Shows the progress of one level on the main rank; on others it is silent.

    Args:
        folder: of the run; TensorBoard's files go to `tensorboard` in it.
        level: from 1.
        resolution: voxels along each axis.
        steps: of the optimiser that are done: TensorBoard forgets later ones, which a killed run made.
        unit: of the MAD, ` mm` or nothing.
        active: whether to show and write anything.
        console: where to.
    """

    def __init__(self, folder: Path, level: int, resolution: int, steps: int, unit: str, active: bool,
                 console: Console) -> None:
        self._folder, self._console, self._unit, self._active = folder, console, unit, active
        self._name = f"level {level}, {resolution}³"
        self._prefix = f"level{level}"
        self._writer = _tensorboard(folder / "tensorboard" / self._prefix, steps) if active else None
        self._progress = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                                  TimeRemainingColumn(), TextColumn("{task.fields[note]}"), console=console,
                                  disable=not (active and console.is_terminal))
        self._stepped: float | None = None  # when the last step was done
        self._task = self._progress.add_task(self._name, total=None, note="")

    def __enter__(self) -> Reporter:
        self._progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._progress.stop()
        if self._writer is not None:
            self._writer.close()

    def begin(self, what: str, total: int, done: int = 0) -> None:
        """A new bar."""
        self._stepped = None  # what lies between is no part of a step
        self._progress.reset(self._task, total=total, completed=done, note="",
                             description=f"{self._name}, {what}")

    def advance(self, note: str = "") -> None:
        """One batch more."""
        self._progress.advance(self._task)
        if note:
            self._progress.update(self._task, note=note)

    def step(self, steps: int, loss: float, learning_rate: float) -> None:
        """A step of the optimiser, done with a learning rate; the time since the one before is shown too."""
        now = time.monotonic()
        if self._writer is not None:
            self._writer.add_scalar(f"{self._prefix}/train_loss", loss, steps)
            self._writer.add_scalar(f"{self._prefix}/learning_rate", learning_rate, steps)
            if self._stepped is not None:
                self._writer.add_scalar(f"{self._prefix}/step_seconds", now - self._stepped, steps)
        self._stepped = now

    def epoch(self, rows: Sequence[EpochRow], validation: Validation) -> None:
        """The end of an epoch; `rows` are all of the run, this one last, of which `validation` tells more."""
        if not self._active:
            return
        row = rows[-1]
        if self._writer is not None:
            for name in ("val_mad", "val_iou", "val_f_score"):
                self._writer.add_scalar(f"{self._prefix}/{name}", getattr(row, name), row.steps)
            for name, value in region_scalars(validation.regions):
                self._writer.add_scalar(f"{self._prefix}/val_mad_by_region/{name}", value, row.steps)
            if validation.picture is not None:
                self._writer.add_image(f"{self._prefix}/input, reconstruction, truth", validation.picture,
                                       row.steps, dataformats="HWC")
            self._writer.flush()
        write_curves(self._folder, rows)
        self._console.print(f"{self._name}, epoch {row.epoch}: loss {row.train_loss:.5f}, validation MAD "
                            f"{row.val_mad:.4g}{self._unit}, IoU {row.val_iou:.3f}, surface F-score "
                            f"{validation.f_score:.3f}, {row.seconds:.0f} s"
                            f"{', best' if row.best else ''}", highlight=False)


def write_curves(folder: Path, rows: Sequence[EpochRow]) -> None:
    """Replace `curves.csv`."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(EpochRow)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    Store(folder).put_bytes(CURVES, text.getvalue().encode())


def _tensorboard(folder: Path, steps: int) -> Any:
    from torch.utils.tensorboard import SummaryWriter  # seconds to import

    return SummaryWriter(str(folder), purge_step=steps + 1)
