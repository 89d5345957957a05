"""7-Scenes folders (Shotton et al. 2013), also those of 3DMatch: a depth map and a pose for each frame.

    *intrinsics*.txt        3x3, pixels, for all frames
    frame-NAME.depth.png    16 bits, millimetres; 0 and 65535 are no measurement
    frame-NAME.pose.txt     4x4, camera to world, metres
    frame-NAME.color.png    or .jpg, where there is colour: taken as registered to the depth,
                            of its size or of the same shape

7-Scenes itself comes without the intrinsics file; its description gives 585, 585, 320, 240. Its colour is not
registered to its depth: a note says so where there is colour.
"""

from __future__ import annotations

from pathlib import Path

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.scans.listing import (
    Frame,
    Listing,
    ScanFormat,
    by_number,
    check_pinhole,
    names_in,
    own_intrinsics,
    unmatched,
)
from ocnf_data.views.scans.text import read_matrix

_DEPTH, _POSE = ".depth.png", ".pose.txt"
_COLOURS = (".color.png", ".color.jpg")


def _fits(folder: Path) -> bool:
    return any((name.startswith("frame-") and name.endswith((_DEPTH, _POSE)))
               or ("intrinsics" in name and name.endswith(".txt")) for name in names_in(folder))


def _read(folder: Path, given: bool) -> Listing:
    names = set(names_in(folder))
    texts = sorted(name for name in names if "intrinsics" in name)
    K = own_intrinsics(lambda: _intrinsics(folder, texts), given)
    depths, poses = _stems(names, _DEPTH), _stems(names, _POSE)
    if not depths:
        raise OcnfError("holds no frames", code="empty", where=folder, expected=f"frame-*{_DEPTH}")
    frames = []
    for stem in sorted(depths & poses, key=by_number):
        colour = next((folder / (stem + suffix) for suffix in _COLOURS if stem + suffix in names), None)
        pose = folder / (stem + _POSE)
        frames.append(Frame(stem, folder / (stem + _DEPTH), read_matrix(pose, 4, 4), pose, K, colour))
    return Listing(tuple(frames), notes=tuple(unmatched(depths, poses)),
                   intrinsics="put a .txt with `intrinsics` in its name, 3x3 numbers in pixels, beside the "
                              "frames, or give them as FX,FY,CX,CY (7-Scenes: 585,585,320,240)",
                   colour="the colour images are taken as registered to the depth maps, which those of the "
                          "published 7-Scenes are not: there colours lie beside what they belong to")


def _stems(names: set[str], suffix: str) -> set[str]:
    return {name.removesuffix(suffix) for name in names
            if name.startswith("frame-") and name.endswith(suffix)}


def _intrinsics(folder: Path, candidates: list[str]) -> F64 | None:
    texts = [folder / name for name in candidates if name.endswith(".txt")]
    if len(texts) > 1:
        raise OcnfError("the folder has to have one file of intrinsics", where=folder,
                        found=", ".join(file.name for file in texts))
    return check_pinhole(read_matrix(texts[0], 3, 3), texts[0]) if texts else None


SEVEN_SCENES = ScanFormat("7scenes", "frame-*.depth.png and frame-*.pose.txt", _fits, _read)
