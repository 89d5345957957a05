"""Posed depth scans: what a user has of a scene, in whatever format, as `Views`.

`read_scan` is the one way in. A format is a module with a `ScanFormat`: whether a folder fits, and its
listing of frames, each with its files, its pose as the file has it, and what its numbers mean. What happens
after that (`load`) is the same for all. A pixel without a measurement becomes 0, never a free ray: a camera
that measures nothing has not looked far.

Nothing is guessed: units, the direction of the poses, intrinsics and invalid values are the format's, or the
user's. Then neighbouring frames are laid over each other (`agreement`), and a note with figures says if they
agree better under another reading.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path

from ocnf_data.errors import OcnfError
from ocnf_data.views.scans.kept import is_kept, read_kept_views
from ocnf_data.views.scans.listing import Axes, Direction, Listing, Said, ScanFormat, convention
from ocnf_data.views.scans.load import load
from ocnf_data.views.scans.redwood import OPEN3D
from ocnf_data.views.scans.scan import Colour, Scan
from ocnf_data.views.scans.scannet import SCANNET
from ocnf_data.views.scans.seven_scenes import SEVEN_SCENES
from ocnf_data.views.scans.transforms import TRANSFORMS
from ocnf_data.views.scans.tum import TUM
from ocnf_data.views.scans.voxlets import VOXLETS

__all__ = ["SCAN_FORMATS", "Axes", "Colour", "Direction", "Scan", "list_scan", "read_scan"]

SCAN_FORMATS: dict[str, ScanFormat] = {
    one.name: one for one in (SEVEN_SCENES, TUM, OPEN3D, TRANSFORMS, SCANNET, VOXLETS)}
"""The formats of scans by the name that `--format` takes."""


def read_scan(place: str | os.PathLike[str], *, every: int = 1, frames: str | int | None = None,
              format: str | None = None, depth_scale: float | None = None,
              intrinsics: Sequence[float] | None = None, poses: str | None = None, pose_scale: float = 1.0,
              crop: Sequence[int] = (0, 0, 0, 0), axes: str | None = None, colour: bool = True,
              report: Callable[[int, int], None] | None = None) -> Scan:
    """Read a scan of any format that is known here.

    Args:
        place: a folder, or `FILE.h5::KEY` of kept views, whose numbers have one meaning: `depth_scale` and
            what follows it are refused.
        every: take every n-th frame only.
        frames: how many, evenly spread, or START:STOP:STEP (see `choose`).
        format: one of SCAN_FORMATS; None: the one that the folder's names fit.
        depth_scale: units of the stored depth in a metre, in place of the format's.
        intrinsics: (fx, fy, cx, cy) of the depth maps in pixels, in place of the scan's.
        poses: `camera-to-world` or `world-to-camera`, in place of the format's.
        pose_scale: length in metres of a unit of the poses' translations.
        crop: pixels along (left, top, right, bottom) of the depth maps that are not used.
        axes: axes of the cameras in the poses, in place of the format's: `opencv` (x right, y down, z
            forward) or `opengl` (y up, z backward).
        colour: whether the colour images are looked for.
        report: told (frames read, frames in all) after each frame.

    Raises:
        OcnfError: nothing there (`missing`), no known format or several, no frame that can be used (`empty`),
            or one that is wrong, with its file: it is never left out in silence.
    """
    direction = None if poses is None else convention(Direction, poses, "read_scan", "poses")
    looks = None if axes is None else convention(Axes, axes, "read_scan", "axes")
    said = Said(depth_scale, _four(intrinsics), direction, pose_scale, _whole(crop), looks)
    text = _named(place)
    if format is None and is_kept(text):
        _refuse(said, text)
        return read_kept_views(text, frames, every)
    listing, name = list_scan(text, format, intrinsics is not None)
    return load(listing, text, name, frames, every, said, report, colour)


def list_scan(folder: str | os.PathLike[str], format: str | None = None,
              given: bool = False) -> tuple[Listing, str]:
    """What a folder says of its frames, before any image is decoded; and the name of its format.

    Args:
        folder: a folder of any format in SCAN_FORMATS.
        format: one of SCAN_FORMATS; None: the one that the folder's names fit.
        given: whether intrinsics are given in place of the scan's, which may then be missing or wrong.

    Raises:
        OcnfError: nothing there (`missing`), no known format or several, a file of poses or intrinsics that
            cannot be read, with its name.
    """
    path = Path(_named(folder))
    if not path.exists():
        raise OcnfError("no such scan", code="missing", where=path)
    chosen = _pick(path, format)
    return chosen.read(path, given), chosen.name


def _named(place: object) -> str:
    """The text of a path; an empty one would be the working directory."""
    text = os.fspath(place) if isinstance(place, str | os.PathLike) else None
    if not isinstance(text, str) or not text:
        raise OcnfError("not a path", where="read_scan", field="place", found=repr(place),
                        expected="a scan's folder, or FILE.h5::KEY")
    return text


def _pick(folder: Path, name: str | None) -> ScanFormat:
    if name is not None:
        if name not in SCAN_FORMATS:
            raise OcnfError("no such format of scans", field="format", found=name,
                            expected=", ".join(SCAN_FORMATS))
        if not folder.is_dir():
            raise OcnfError("not a folder", where=folder, expected=SCAN_FORMATS[name].holds)
        return SCAN_FORMATS[name]
    fitting = [one for one in SCAN_FORMATS.values() if one.fits(folder)]
    if len(fitting) > 1:
        raise OcnfError("the folder fits several formats", where=folder,
                        found=", ".join(one.name for one in fitting), fix="name its format (--format)")
    if not fitting:
        known = "; ".join(f"{one.name}: {one.holds}" for one in SCAN_FORMATS.values())
        raise OcnfError("not a scan of a known format", where=folder,
                        expected=f"kept views as FILE.h5::KEY, or a folder with what one of these holds "
                                 f"({known})")
    return fitting[0]


def _refuse(said: Said, place: str) -> None:
    """Refuse what the user says of views that need no interpretation: to leave it out would look obeyed."""
    for one in fields(said):
        value = getattr(said, one.name)
        if value != one.default:
            raise OcnfError("kept views say themselves what their numbers mean", where=place, found=value,
                            field="poses" if one.name == "direction" else one.name, fix="leave it out")


def _four(intrinsics: Sequence[float] | None) -> tuple[float, float, float, float] | None:
    if intrinsics is None:
        return None
    try:
        fx, fy, cx, cy = (float(value) for value in intrinsics)
    except (TypeError, ValueError) as error:
        raise OcnfError("not intrinsics", where="read_scan", field="intrinsics", found=intrinsics,
                        expected="four numbers: fx, fy, cx, cy in pixels") from error
    return fx, fy, cx, cy


def _whole(crop: Sequence[int]) -> tuple[int, int, int, int]:
    try:
        if any(not math.isfinite(n) or n != int(n) for n in crop):
            raise ValueError
        left, top, right, bottom = (int(n) for n in crop)
    except (TypeError, ValueError) as error:
        raise OcnfError("not a crop", where="read_scan", field="crop", found=crop,
                        expected="pixels (left, top, right, bottom)") from error
    return left, top, right, bottom
