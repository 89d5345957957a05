"""What a format knows of a scan before any image is decoded, and what the user says about it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import groupby
from numbers import Real
from operator import itemgetter
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.views.rigs import intrinsics as pinhole

MILLIMETRES = 1e-3
"""Length in metres of a unit of depth stored in millimetres."""


class Direction(StrEnum):
    """What a pose matrix does with a point."""

    CAMERA_TO_WORLD = "camera-to-world"
    """The matrix takes points from the camera's coordinates to the world's."""
    WORLD_TO_CAMERA = "world-to-camera"
    """The matrix takes points from the world's coordinates to the camera's."""


class Axes(StrEnum):
    """How the axes of a camera lie."""

    OPENCV = "opencv"
    """x right, y down, z forward."""
    OPENGL = "opengl"
    """x right, y up, z backward."""


_MOST_SPANS = 12  # in a note
_Choice = TypeVar("_Choice", bound=StrEnum)
_Read = TypeVar("_Read")


def convention(kind: type[_Choice], value: object, where: object, field: str) -> _Choice:
    """The member of an enumeration that has this value.

    Raises:
        OcnfError: there is none.
    """
    if isinstance(value, str) and value in list(kind):
        return kind(value)
    what = "direction of poses" if issubclass(kind, Direction) else "convention of axes"
    raise OcnfError(f"not a {what}", where=where, field=field, found=value, expected=" or ".join(kind))


@dataclass(frozen=True)
class Frame:
    """One posed depth map.

    Attributes:
        name: name of the frame, for messages.
        depth: file of the depth map.
        pose: (4, 4) as the format has it; not finite where the tracking was lost.
        where: the file that the pose is from.
        K: (3, 3) of the depth map, pixel centres on integers; None where the scan does not say.
        colour: the colour image of the same moment and pose.
        K_colour: (3, 3) of the colour image; None: the depth map's, scaled to the image's size.
    """

    name: str
    depth: Path
    pose: F64
    where: Path
    K: F64 | None
    colour: Path | None = None
    K_colour: F64 | None = None


@dataclass(frozen=True)
class Listing:
    """The frames of a scan in order, and what their numbers mean.

    Attributes:
        frames: the frames that have depth and pose.
        unit: length in metres of a unit of the stored depth.
        direction, axes: direction of the pose matrices, and axes of the cameras in them.
        cube: (centre, side) in metres of the space that the scan is about, where the format says.
        notes: a sentence for each thing left out or assumed.
        intrinsics: what to do where K is None.
        colour: a sentence on the colour images, for a scan that has some.
    """

    frames: tuple[Frame, ...]
    unit: float = MILLIMETRES
    direction: Direction = Direction.CAMERA_TO_WORLD
    axes: Axes = Axes.OPENCV
    cube: tuple[tuple[float, float, float], float] | None = None
    notes: tuple[str, ...] = ()
    intrinsics: str = "give them as FX,FY,CX,CY"
    colour: str | None = None


@dataclass(frozen=True)
class ScanFormat:
    """A format of scans.

    Attributes:
        name: the name that `--format` takes.
        holds: what a folder of it holds, for messages.
        fits: whether a folder, by the names in it, is of this format.
        read: the folder's listing. The second argument says whether intrinsics are given from elsewhere: then
            the scan's own may be missing or wrong.
    """

    name: str
    holds: str
    fits: Callable[[Path], bool]
    read: Callable[[Path, bool], Listing]


@dataclass(frozen=True)
class Said:
    """What the user says in place of the format's own definition; None: the definition holds.

    Attributes:
        depth_scale: units of the stored depth in a metre (1000: millimetres, 5000: TUM's).
        intrinsics: (fx, fy, cx, cy) in pixels of the depth map.
        direction: what the pose matrices in the files do with a point: camera to world, or world to camera.
        pose_scale: metres a unit of the poses' translations (0.001 for a trajectory in millimetres).
        crop: pixels along (left, top, right, bottom) of each depth map that are not used.
        axes: axes of the cameras in the pose matrices: OpenCV's or OpenGL's.
    """

    depth_scale: float | None = None
    intrinsics: tuple[float, float, float, float] | None = None
    direction: Direction | None = None
    pose_scale: float = 1.0
    crop: tuple[int, int, int, int] = (0, 0, 0, 0)
    axes: Axes | None = None

    def __post_init__(self) -> None:
        for field, value in (("depth_scale", self.depth_scale), ("pose_scale", self.pose_scale)):
            if value is not None:
                check_scale(value, "read_scan", field)
        if len(self.crop) != 4 or min(self.crop) < 0:
            raise OcnfError("not a crop", where="read_scan", field="crop", found=self.crop,
                            expected="pixels (left, top, right, bottom), none of them negative")
        if self.intrinsics is not None:
            check_pinhole(pinhole(*self.intrinsics), "read_scan")


def check_scale(value: Any, where: object, field: str) -> float:
    """A number of units in another one, finite and above 0.

    Raises:
        OcnfError: it is not.
    """
    try:
        fits = (isinstance(value, Real) and not isinstance(value, bool) and float(value) > 0
                and np.isfinite([float(value), 1 / float(value)]).all())
    except (OverflowError, ZeroDivisionError):  # an integer too large for a float, a fraction too small
        fits = False
    if not fits:
        raise OcnfError("not a scale", where=where, field=field, found="none" if value is None else value,
                        expected="a number above 0")
    return float(value)


def check_pinhole(K: F64, where: object) -> F64:
    """K (3, 3) if it is that of a pinhole without skew.

    Raises:
        OcnfError: it is not.
    """
    fits = np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0
    if not fits or not np.array_equal(K * [[0, 1, 0], [1, 0, 0], [1, 1, 1]], np.diag([0.0, 0.0, 1.0])):
        raise OcnfError("not a pinhole's intrinsics", where=where, found=K.tolist(),
                        expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], finite, with fx, fy > 0")
    return K


def own_intrinsics(read: Callable[[], _Read], given: bool) -> _Read | None:
    """What `read` gives of the scan's intrinsics; None where they are given from elsewhere and it fails."""
    try:
        return read()
    except OcnfError:
        if not given:
            raise
        return None


def names_in(folder: Path) -> list[str]:
    """The names of all that lies directly in a folder, sorted; none where it is not a folder.

    Hidden ones do not count, such as the `._0.png` that macOS puts beside `0.png` on foreign disks.
    """
    if not folder.is_dir():
        return []
    with storage_errors(folder):
        return sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))


def numbered(folder: Path, suffixes: Iterable[str]) -> dict[str, Path]:
    """The files of a folder with one of the suffixes, by stem, in the order of the numbers in their names."""
    chosen = [Path(name) for name in names_in(folder) if Path(name).suffix.lower() in suffixes]
    return {name.stem: folder / name for name in sorted(chosen, key=lambda name: by_number(name.stem))}


def by_number(stem: str) -> tuple[list[int], str]:
    """What names are sorted by: the numbers in them, and where these are the same, the name."""
    return [int(digits) for digits in re.findall(r"\d+", stem)], stem


def unmatched(depths: Iterable[str], poses: Iterable[str]) -> list[str]:
    """A note on the depth maps without a pose, and one on the poses without a depth map."""
    maps, posed = set(depths), set(poses)
    names = sorted(maps | posed, key=by_number)
    return [*left_out("depth map", "without a pose", names, [name not in posed for name in names]),
            *left_out("pose", "without a depth map", names, [name not in maps for name in names])]


def left_out(thing: str, why: str, names: Sequence[str], missing: Sequence[bool]) -> list[str]:
    """A note on those of the names that are left out, or none; neighbours in the order are one span.

    >>> left_out("frame", "without a pose", ["1", "2", "3", "4", "5"], [True, False, True, True, True])
    ['4 frames without a pose, left out: 1, 3 to 5']

    Args:
        thing: what a name is of.
        why: as a clause.
        names: all names, in order.
        missing: for each, whether it is left out.
    """
    spans = [[name for name, _ in span]
             for gone, span in groupby(zip(names, missing, strict=True), itemgetter(1)) if gone]
    words = [word for span in spans
             for word in ([f"{span[0]} to {span[-1]}"] if len(span) > 2 else span)]
    if more := len(words[_MOST_SPANS:]):
        words = [*words[:_MOST_SPANS], f"and {more} more such"]
    n = sum(missing)
    return [f"{n} {thing}{'s' * (n != 1)} {why}, left out: {', '.join(words)}"] if n else []


def below(folder: Path, file: Path, name: object, field: str) -> Path:
    """The path that a file of a scan names, which lies below the scan's folder.

    Raises:
        OcnfError: it does not, or is none.
    """
    path = PurePosixPath(str(name).replace("\\", "/"))
    if not isinstance(name, str) or path.is_absolute() or ".." in path.parts or "\0" in name:
        raise OcnfError("not a path below the scan's folder", where=file, field=field, found=name,
                        expected="a relative path without ..")
    return folder / path
