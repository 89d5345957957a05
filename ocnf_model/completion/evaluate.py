"""All methods on the frames of a split: figures of each frame, their means as a table, and pictures.

    DIR/completion.md       the table of means, and what was compared
    DIR/frames.csv          a line a frame and method
    DIR/completion.png      some frames: the view, the completions and the ground truth side by side
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import track

from ocnf_data.arrays import Bool
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.targets import check_file
from ocnf_data.terminal import narrow_table
from ocnf_model.completion.figure import DrawnFrame, draw_completions
from ocnf_model.completion.methods import OURS, Completion, methods_of
from ocnf_model.completion.predict import CompletionNetwork
from ocnf_model.completion.scores import Scores
from ocnf_model.completion.visible import Visible
from ocnf_model.completion.voxlets import VoxletsFrame, list_frames

_HEAD = ("method", "IoU", "precision", "recall", "seconds")
_DRAWN = ("extrusion", "structured forest", OURS)


@dataclass(frozen=True)
class FrameRow:
    """Figures of a method on a frame; `seconds` are those of the method alone, on this machine."""

    method: str
    frame: str
    scores: Scores
    seconds: float


def run_completion_evaluation(run: str | None, data: str, *, out: Path, split: str = "test",
                              forest: bool = True, figures: int = 3, device: str = "auto",
                              console: Console | None = None) -> list[FrameRow]:
    """Compare the methods, print the table, and write table, figures of all frames and pictures.

    Args:
        run: folder of a run, `pretrained`, or None for the baselines alone.
        data: folder of the Voxlets data.
        out: folder that the results are written to.
        split: `test` or `train`.
        forest: whether to fit the structured forest, which takes some minutes.
        figures: number of frames that are drawn, spread over the split.
        device: `auto`, `cpu`, `cuda`.
        console: where the table is shown.
    """
    console = console or Console(emoji=False)
    check_file(out / "frames.csv")  # before hours of completing
    frames = list_frames(data, split)
    network = None if run is None else CompletionNetwork(run, device)
    methods, notes = methods_of(data, network, forest)
    store, rows, pictures = Store(out), list[FrameRow](), list[DrawnFrame]()
    drawn = {frames[i * len(frames) // max(figures, 1)].name for i in range(figures)}
    for frame in track(frames, "completing", console=console, transient=True):
        found = _complete(frame, methods, rows)
        if frame.name in drawn:
            scene = frame.read()
            shown = {name: found[name] for name in _DRAWN if name in found}
            scores = {row.method: row.scores for row in rows if row.frame == frame.name}
            pictures.append(DrawnFrame(scene, shown, scores))
    if pictures:
        store.put_bytes("completion.png", draw_completions(pictures))
    lines = _lines(rows, list(methods))
    table = narrow_table(f"Completion of {len(frames)} frames, split {split}")
    for i, name in enumerate(_HEAD):
        table.add_column(name, justify="left" if i == 0 else "right")
    for line in lines:
        table.add_row(*line)
    console.print(table)
    for note in notes:
        console.print(note, highlight=False)
    store.put_bytes("completion.md", _markdown(lines, notes, len(frames), split).encode())
    store.put_bytes("frames.csv", _csv(rows).encode())
    return rows


def _complete(frame: VoxletsFrame, methods: Mapping[str, Completion],
              rows: list[FrameRow]) -> dict[str, Bool]:
    scene = frame.read()
    judged = Visible.of(scene.view, scene.shape, scene.voxel).judged
    if not (judged & scene.known).any():
        raise OcnfError("the frame looks at no voxel that is known", code="empty", where=frame.name,
                        fix="check shape and voxelsize in tsdf_meta.yaml, and the frame's pose")
    found = {}
    for name, method in methods.items():
        began = time.monotonic()
        found[name] = method(scene)
        rows.append(FrameRow(name, frame.name, Scores.of(scene.occupied, found[name], judged),
                             time.monotonic() - began))
    return found


def _lines(rows: Sequence[FrameRow], methods: Sequence[str]) -> list[list[str]]:
    lines = []
    for method in methods:
        own = [row for row in rows if row.method == method]
        mean = Scores.mean([row.scores for row in own])
        lines.append([method, f"{mean.iou:.3f}", f"{mean.precision:.3f}", f"{mean.recall:.3f}",
                      f"{sum(row.seconds for row in own) / len(own):.2f}"])
    return lines


def _markdown(lines: Sequence[Sequence[str]], notes: Sequence[str], n: int, split: str) -> str:
    rows = [_HEAD, ("---", *["---:"] * (len(_HEAD) - 1)), *lines]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return f"Unweighted means over the {n} frames of the split {split}.\n\n{table}\n\n" \
        + "".join(f"- {note}\n" for note in notes)


def _csv(rows: Sequence[FrameRow]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frame", "method", "iou", "precision", "recall", "seconds"])
    for row in rows:
        figures = (row.scores.iou, row.scores.precision, row.scores.recall)
        writer.writerow([row.frame, row.method, *(f"{value:.4f}" for value in figures), f"{row.seconds:.2f}"])
    return text.getvalue()
