"""`transforms.json` of nerfstudio, and what its converters make of Polycam and Record3D captures.

    fl_x fl_y cx cy w h     of the images, for all frames or in a frame of its own; or camera_angle_x
    frames[].file_path            the colour image
    frames[].depth_file_path      16-bit PNG in millimetres, or an NPY in millimetres; 0 is no measurement
    frames[].transform_matrix     4x4, camera to world, metres, OpenGL's axes (x right, y up, z backward)

Depth maps may be smaller than the images (an iPhone's are 256x192): the intrinsics are scaled. Here the
centre of the first pixel is at (0.5, 0.5) (`pixel_offset` in nerfstudio's cameras), elsewhere in this package
at (0, 0): half a pixel is taken off. Lens distortion is not applied; a note says so where there is some.
"""

from __future__ import annotations

import math
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import resized
from ocnf_data.views.rigs import intrinsics as pinhole
from ocnf_data.views.scans.images import image_size
from ocnf_data.views.scans.listing import Axes, Frame, Listing, ScanFormat
from ocnf_data.views.scans.text import json_array, read_json

_FILE = "transforms.json"
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def _fits(folder: Path) -> bool:
    return (folder / _FILE).is_file()


def _read(folder: Path) -> Listing:
    file = folder / _FILE
    data = read_json(file)
    entries = data.get("frames")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise OcnfError("not a list of frames", where=file, field="frames")
    notes, frames = [], []
    for i, entry in enumerate(entries):
        if not entry.get("depth_file_path"):
            notes.append(f"frames[{i}]: no depth_file_path, left out")
            continue
        frames.append(_frame(folder, file, data, entry, i))
    if not frames:
        raise OcnfError("no frame has depth", code="empty", where=file, found=f"{len(entries)} frames",
                        expected="depth_file_path in each",
                        fix="capture with a depth camera (LiDAR), or convert with depth")
    scale = data.get("applied_scale", 1.0)
    if scale != 1.0:
        notes.append(f"the file says that its poses were scaled by {scale} (applied_scale), so that they are "
                     "not in metres: give the pose scale that undoes it")
    return Listing(tuple(frames), axes=Axes.OPENGL, notes=(*_distortion(data, entries), *notes),
                   intrinsics="fl_x, fl_y, cx and cy belong into transforms.json, or give FX,FY,CX,CY")


def _frame(folder: Path, file: Path, data: dict[str, Any], entry: dict[str, Any], i: int) -> Frame:
    depth = _inside(folder, file, entry["depth_file_path"], f"frames[{i}].depth_file_path")
    pose = json_array(entry.get("transform_matrix"), (4, 4), file, f"frames[{i}].transform_matrix")
    colour = entry.get("file_path")
    image = None if not colour else _inside(folder, file, colour, f"frames[{i}].file_path")
    if image is not None and not image.is_file():  # the images are not needed, and often left behind
        image = None
    K, K_colour = _intrinsics(file, {**data, **entry}, depth, image, i)
    return Frame(str(entry["depth_file_path"]), depth, pose, file, K, image, K_colour)


def _intrinsics(file: Path, camera: dict[str, Any], depth: Path, image: Path | None,
                i: int) -> tuple[F64 | None, F64 | None]:
    """K of the depth map, and of the colour image."""
    model = camera.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise OcnfError("not a pinhole camera", where=file, field="camera_model", found=model,
                        expected=" or ".join(_MODELS))
    width, height = camera.get("w"), camera.get("h")
    if isinstance(width, int | float) and isinstance(height, int | float) and 0 < width * height < 1e12:
        size = int(height), int(width)
    else:
        size = image_size(image or depth)
    values = [camera.get(name) for name in ("fl_x", "fl_y", "cx", "cy")]
    angle = camera.get("camera_angle_x")
    if values[0] is None and isinstance(angle, int | float) and 0 < angle < math.pi:
        focal = 0.5 * size[1] / math.tan(0.5 * angle)
        values = [focal, focal, size[1] / 2, size[0] / 2]
    if values[0] is not None and values[1] is None:
        values[1] = values[0]
    if any(value is None for value in values):
        return None, None
    fx, fy, cx, cy = json_array(values, (4,), file, f"frames[{i}]: fl_x, fl_y, cx, cy")
    K = pinhole(fx, fy, cx - 0.5, cy - 0.5)
    K_colour = None if image is None else resized(K, size, image_size(image))
    return resized(K, size, image_size(depth)), K_colour


def _inside(folder: Path, file: Path, name: Any, field: str) -> Path:
    path = PurePosixPath(str(name).replace("\\", "/"))
    if not isinstance(name, str) or path.is_absolute() or ".." in path.parts or "\0" in name:
        raise OcnfError("not a path below the scan's folder", where=file, field=field, found=name,
                        expected="a relative path without ..")
    return folder / path


def _distortion(data: dict[str, Any], entries: list[dict[str, Any]]) -> list[str]:
    largest = max((abs(float(camera.get(name) or 0)) for camera in (data, *entries) for name in _DISTORTION
                   if isinstance(camera.get(name), int | float)), default=0.0)
    if largest == 0 or not np.isfinite(largest):
        return []
    return [f"the lens has distortion (coefficients up to {largest:.2g}), which is not applied"]


TRANSFORMS = ScanFormat("transforms", "transforms.json whose frames have depth_file_path", _fits, _read)
