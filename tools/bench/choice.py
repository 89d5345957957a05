"""What each measure of the best epoch would have chosen in runs that are done, stopped after some epochs.

    python tools/bench/choice.py RUN... --after 4 6 8

Reads the curves of each run's first level. For each measure: the means over the runs of what the chosen
epoch has on the validation samples, and the worst that any run loses against its own best epoch by a figure.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from ocnf_model.training.choice import BestBy


class Figures(NamedTuple):
    """What an epoch has on the validation samples."""

    mad: float
    iou: float
    f_score: float


def read_curves(run: Path) -> list[Figures]:
    """The epochs of the first level, in order."""
    with (run / "curves.csv").open(encoding="utf-8", newline="") as file:
        return [Figures(float(row["val_mad"]), float(row["val_iou"]), float(row["val_f_score"]))
                for row in csv.DictReader(file) if row["level"] == "1"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--after", nargs="+", type=int, default=[4, 6, 8], help="epochs")
    arguments = parser.parse_args()
    curves = [read_curves(run) for run in arguments.runs]
    table = Table(title=f"{len(curves)} runs, epochs chosen by each measure")
    for heading in ("after", "measure", "MAD mm", "IoU", "F-score", "MAD, worst", "IoU, worst", "F, worst"):
        table.add_column(heading, justify="left" if heading == "measure" else "right")
    for after in arguments.after:
        for measure in BestBy:
            chosen, lost = [], []
            for epochs in (rows[:after] for rows in curves):
                found = min(epochs, key=lambda row: measure.cost(*row))
                chosen.append(found)
                lost.append((found.mad / min(row.mad for row in epochs),
                             max(row.iou for row in epochs) - found.iou,
                             max(row.f_score for row in epochs) - found.f_score))
            (mad, iou, f_score), (more, less, fewer) = np.mean(chosen, axis=0), np.max(lost, axis=0)
            table.add_row(str(after), measure, f"{mad:.2f}", f"{iou:.3f}", f"{f_score:.3f}", f"x {more:.2f}",
                          f"-{less:.3f}", f"-{fewer:.3f}")
        table.add_section()
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
