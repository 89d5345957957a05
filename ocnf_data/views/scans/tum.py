"""TUM RGB-D sequences (Sturm et al. 2012), and ETH3D's in the same form.

    depth.txt           lines `timestamp file`: 16-bit PNG, 5000 units a metre, 0 is no measurement
    rgb.txt             the same for colour, registered to the depth; may be missing
    groundtruth.txt     lines `timestamp tx ty tz qx qy qz qw`: camera to world, metres
    calibration.txt     `fx fy cx cy`, ETH3D's (more is not applied); where it is missing,
                        the benchmark's own advice for its registered depth holds:
                        525 525 319.5 239.5, for 640x480

A line that begins with # is a comment. The streams have clocks of their own: entries are associated as the
benchmark's `associate.py` does it, closest first, each at most once, at most 0.02 s apart.
(`evo` reads and associates such trajectories too, but brings pandas, seaborn and rosbags with it.)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.rigs import intrinsics as pinhole
from ocnf_data.views.scans.images import image_size
from ocnf_data.views.scans.listing import Frame, Listing, ScanFormat, below, own_intrinsics
from ocnf_data.views.scans.poses import quaternion_pose
from ocnf_data.views.scans.text import numbers, read_table

MAX_DIFFERENCE = 0.02
"""Seconds between two entries that belong together."""
_UNITS_IN_A_METRE = 5000
_DEFAULT_SIZE, _DEFAULT = (480, 640), (525.0, 525.0, 319.5, 239.5)


def associate(first: Sequence[float] | F64, second: Sequence[float] | F64,
              max_difference: float = MAX_DIFFERENCE) -> list[tuple[int, int]]:
    """Pairs of positions of times (seconds) that belong together, ascending; closest first, each once."""
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    order = np.argsort(b, kind="stable")
    low = np.searchsorted(b[order], a - max_difference)
    high = np.searchsorted(b[order], a + max_difference, side="right")
    candidates = [(abs(a[i] - b[j]), i, int(j)) for i in range(len(a)) for j in order[low[i] : high[i]]]
    free_a, free_b = np.ones(len(a), bool), np.ones(len(b), bool)
    pairs = []
    for _, i, j in sorted(candidates):
        if free_a[i] and free_b[j]:
            free_a[i] = free_b[j] = False
            pairs.append((i, j))
    return sorted(pairs)


def _fits(folder: Path) -> bool:
    return (folder / "depth.txt").is_file()


def _read(folder: Path, given: bool) -> Listing:
    depth_times, depths = _images(folder, "depth.txt")
    trajectory = folder / "groundtruth.txt"
    if not trajectory.is_file():
        raise OcnfError("has no poses", code="missing", where=folder, expected="groundtruth.txt")
    rows = [_pose_row(trajectory, line, words) for line, words in read_table(trajectory)]
    pairs = dict(associate(depth_times, [row[0] for row in rows]))
    if not depths or not pairs:
        raise OcnfError("no depth map has a pose of its time", code="empty", where=folder,
                        found=f"{len(depths)} depth maps, {len(rows)} poses",
                        expected=f"timestamps at most {MAX_DIFFERENCE} s apart")
    colour_times, colours = _images(folder, "rgb.txt") if (folder / "rgb.txt").is_file() else ([], [])
    coloured = dict(associate([depth_times[i] for i in pairs], colour_times))
    K, notes = own_intrinsics(lambda: _intrinsics(folder, depths[next(iter(pairs))]), given) or (None, [])
    frames = []
    for at, (i, j) in enumerate(pairs.items()):
        colour = colours[coloured[at]] if at in coloured else None
        pose = quaternion_pose(rows[j][1:4], rows[j][4:])
        frames.append(Frame(depths[i].stem, depths[i], pose, trajectory, K, colour))
    if left := len(depths) - len(pairs):
        notes.append(f"{left} depth maps have no pose within {MAX_DIFFERENCE} s, left out")
    return Listing(tuple(frames), unit=1 / _UNITS_IN_A_METRE, notes=tuple(notes),
                   intrinsics="put calibration.txt with `fx fy cx cy` beside depth.txt, or give them as "
                              "FX,FY,CX,CY")


def _images(folder: Path, name: str) -> tuple[list[float], list[Path]]:
    times, files = [], []
    for line, words in read_table(folder / name):
        if len(words) != 2:
            raise OcnfError("not a timestamp and a file", where=folder / name, field=f"line {line}",
                            found=" ".join(words), expected="two words, no commas")
        times += numbers(words[:1], folder / name, line)
        files.append(below(folder, folder / name, words[1], f"line {line}"))
    return times, files


def _pose_row(file: Path, line: int, words: list[str]) -> list[float]:
    row = numbers(words, file, line)
    if len(row) != 8:
        raise OcnfError("not a pose with its time", where=file, field=f"line {line}", found=len(row),
                        expected="8 numbers: timestamp tx ty tz qx qy qz qw")
    return row


def _intrinsics(folder: Path, depth: Path) -> tuple[F64 | None, list[str]]:
    file = folder / "calibration.txt"
    if file.is_file():
        values = [value for line, words in read_table(file) for value in numbers(words, file, line)]
        if len(values) < 4:
            raise OcnfError("not intrinsics", where=file, found=f"{len(values)} numbers",
                            expected="fx fy cx cy")
        fx, fy, cx, cy = values[:4]
        further = [f"calibration.txt has {len(values) - 4} numbers after fx fy cx cy, which are not applied"]
        return pinhole(fx, fy, cx, cy), further if len(values) > 4 else []
    if image_size(depth) != _DEFAULT_SIZE:
        return None, []
    return pinhole(*_DEFAULT), ["the intrinsics are those that the TUM benchmark advises for its registered "
                                "depth: 525,525,319.5,239.5"]


TUM = ScanFormat("tum", "depth.txt and groundtruth.txt", _fits, _read)
