"""Folders of Open3D and of Redwood (Choi et al. 2015): a depth folder, a trajectory, intrinsics.

    depth/*.png             16 bits, millimetres unless told otherwise; 0 is no measurement
    color/ rgb/ image/      *.jpg or *.png, registered to the depth; may be missing
    *.log, *traj*.txt       for each frame a line of three numbers, then 4x4, camera to world, metres
    *.json                  or Open3D's PinholeCameraTrajectory: `extrinsic`, world to camera, by columns
    *intrinsic*.json        Open3D's PinholeCameraIntrinsic: `intrinsic_matrix` by columns, `width`, `height`;
                            of several, the one that has `depth` in its name. `depth_scale`, units in a metre,
                            stands beside it where Open3D has read a video of a camera

All but the images may lie in the folder itself or in `scene/`. Poses and images belong together by their
order, as in Open3D, so there has to be one pose for each depth map.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.scans.images import image_size
from ocnf_data.views.scans.listing import (
    MILLIMETRES,
    Direction,
    Frame,
    Listing,
    ScanFormat,
    check_scale,
    names_in,
    numbered,
    own_intrinsics,
)
from ocnf_data.views.scans.text import json_array, numbers, read_json, read_table

_COLOURS = ("color", "rgb", "image")
_SUFFIXES = (".png", ".jpg", ".jpeg")
_TRAJECTORY = "PinholeCameraTrajectory"
_Camera = tuple[F64, tuple[int, int]]  # K, and (H, W) of the images that it is for


def _fits(folder: Path) -> bool:
    plain = not (folder / "transforms.json").exists() and not (folder / "depth.txt").exists()
    return plain and (folder / "depth").is_dir() and bool(_trajectories(folder) or _jsons(folder))


def _trajectories(folder: Path) -> list[Path]:
    return [place / name for place in (folder, folder / "scene") for name in names_in(place)
            if name.endswith(".log") or (name.endswith(".txt") and "traj" in name)]


def _jsons(folder: Path) -> list[Path]:
    return [place / name for place in (folder, folder / "scene") for name in names_in(place)
            if name.endswith(".json") and ("traj" in name or "intrinsic" in name)]


def _read(folder: Path, given: bool) -> Listing:
    depths = list(numbered(folder / "depth", {".png"}).values())
    if not depths:
        raise OcnfError("holds no frames", code="empty", where=folder, expected="depth/*.png")
    whole = [(file, own_intrinsics(partial(read_json, file), given and "traj" not in file.name) or {})
             for file in _jsons(folder)]
    logs = _trajectories(folder)
    trajectories = [*logs, *(file for file, data in whole if data.get("class_name") == _TRAJECTORY)]
    if len(trajectories) != 1:
        raise OcnfError("the folder has to have one trajectory", where=folder,
                        code="invalid" if trajectories else "missing",
                        found=", ".join(file.name for file in trajectories) or "none",
                        expected="a .log, a .txt with `traj` in its name, or Open3D's trajectory .json")
    file = trajectories[0]
    poses, matrices = (_log(file), []) if logs else _camera_list(file, dict(whole)[file], given)
    if len(poses) != len(depths):
        raise OcnfError("poses and depth maps belong together by order, but differ in number", where=file,
                        found=f"{len(poses)} poses, {len(depths)} depth maps")
    one = own_intrinsics(lambda: _depth_camera(folder, whole), given)
    cameras: list[_Camera | None] = [one or each for each in matrices] if matrices else [one] * len(poses)
    colours = _colours(folder, len(depths))
    frames = []
    for depth, pose, camera, colour in zip(depths, poses, cameras, colours, strict=True):
        K = own_intrinsics(partial(_fitting, depth, camera), given)
        frames.append(Frame(depth.stem, depth, pose, file, K, colour))
    direction = Direction.CAMERA_TO_WORLD if logs else Direction.WORLD_TO_CAMERA
    return Listing(tuple(frames), unit=_unit(folder, whole), direction=direction,
                   intrinsics="put Open3D's intrinsic .json beside the trajectory, or give them as "
                              "FX,FY,CX,CY (Redwood's data sets: 525,525,319.5,239.5)")


def _log(file: Path) -> list[F64]:
    """Poses (4, 4) of a .log: blocks of five lines, the first with three numbers that are not needed."""
    rows = [numbers(words, file, line) for line, words in read_table(file)]
    poses = []
    for at in range(0, len(rows), 5):
        block = rows[at : at + 5]
        if [len(row) for row in block] != [3, 4, 4, 4, 4]:
            raise OcnfError("not a trajectory log", where=file, field=f"frame {at // 5}",
                            found=f"lines of {[len(row) for row in block]} numbers",
                            expected="a line of 3 numbers, then four lines of 4")
        poses.append(np.array(block[1:]))
    return poses


def _camera_list(file: Path, data: dict[str, Any], given: bool) -> tuple[list[F64], list[_Camera | None]]:
    """Poses, world to camera, and intrinsics of Open3D's trajectory JSON."""
    cameras = data.get("parameters")
    if not isinstance(cameras, list) or not all(isinstance(camera, dict) for camera in cameras):
        raise OcnfError("not a list of cameras", where=file, field="parameters")
    poses = [json_array(camera.get("extrinsic"), (4, 4), file, f"parameters[{i}].extrinsic").T
             for i, camera in enumerate(cameras)]
    found = [camera.get("intrinsic") for camera in cameras]
    own = [own_intrinsics(partial(_intrinsics, file, camera), given)
           for camera in found if isinstance(camera, dict)]
    return poses, own if len(own) == len(poses) else []


def _unit(folder: Path, whole: list[tuple[Path, dict[str, Any]]]) -> float:
    """Length in metres of a unit of depth: by `depth_scale` where a file has it, else a millimetre."""
    said = {file: check_scale(data["depth_scale"], file, "depth_scale")
            for file, data in whole if "depth_scale" in data}
    if len(set(said.values())) > 1:
        raise OcnfError("the files differ in their depth scale", where=folder,
                        found=", ".join(f"{scale:g} ({file.name})" for file, scale in said.items()),
                        fix="leave depth_scale in the file of the depth camera alone")
    return 1 / next(iter(said.values())) if said else MILLIMETRES


def _depth_camera(folder: Path, whole: list[tuple[Path, dict[str, Any]]]) -> _Camera | None:
    """The intrinsics that hold for all depth maps: of several files, that with `depth` in its name."""
    found = [(file, data) for file, data in whole if "intrinsic_matrix" in data]
    if len(found) > 1:
        named = [each for each in found if "depth" in each[0].name.lower()]
        if len(named) != 1:
            raise OcnfError("the folder has several files of intrinsics", where=folder,
                            found=", ".join(file.name for file, _ in found),
                            expected="one, or one with `depth` in its name")
        found = named
    return _intrinsics(*found[0]) if found else None


def _fitting(depth: Path, camera: _Camera | None) -> F64 | None:
    """K of a depth map, which has the size that the intrinsics are for."""
    if camera is None:
        return None
    if camera[1] != (size := image_size(depth)):
        raise OcnfError("the intrinsics are for images of another size", where=depth, found=size,
                        expected=camera[1])
    return camera[0]


def _intrinsics(file: Path, data: dict[str, Any]) -> tuple[F64, tuple[int, int]]:
    """(K, (H, W))."""
    K = json_array(data.get("intrinsic_matrix"), (3, 3), file, "intrinsic_matrix").T
    height, width = json_array([data.get("height"), data.get("width")], (2,), file, "height and width")
    if not np.isfinite([height, width]).all():
        raise OcnfError("not an image's size", where=file, found=f"{width:g}x{height:g}")
    return K, (int(height), int(width))


def _colours(folder: Path, n: int) -> list[Path | None]:
    for name in _COLOURS:
        found = list(numbered(folder / name, _SUFFIXES).values())
        if found:
            if len(found) != n:
                raise OcnfError("colour images and depth maps belong together by order, but differ in number",
                                where=folder / name, found=len(found), expected=n)
            return [*found]
    return [None] * n


OPEN3D = ScanFormat("open3d", "depth/*.png with a trajectory .log or .json, and an intrinsic .json", _fits,
                    _read)
