"""`transforms.json` of nerfstudio, and what its converters make of Polycam and Record3D captures.

    fl_x fl_y cx cy w h     of the images, for all frames or in a frame of its own; camera_angle_x and
                            camera_angle_y stand in for what is missing, the images' size for w and h
    frames[].file_path            the colour image, perhaps without its suffix; may be missing
    frames[].depth_file_path      16-bit PNG in millimetres, or an NPY in millimetres; 0 is no measurement
    frames[].transform_matrix     4x4, camera to world, metres, OpenGL's axes (x right, y up, z backward)

Depth maps may be smaller than the images (an iPhone's are 256x192): the intrinsics are scaled. Here the
centre of the first pixel is at (0.5, 0.5) (`pixel_offset` in nerfstudio's cameras), elsewhere in this package
at (0, 0): half a pixel is taken off. Lens distortion is not applied; a note says so where there is some.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import resized, same_shape
from ocnf_data.views.rigs import intrinsics as pinhole
from ocnf_data.views.scans.images import image_size
from ocnf_data.views.scans.listing import (
    Axes,
    Frame,
    Listing,
    ScanFormat,
    below,
    check_scale,
    left_out,
    own_intrinsics,
)
from ocnf_data.views.scans.text import json_array, read_json

_FILE = "transforms.json"
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_SUFFIXES = (".png", ".jpg", ".jpeg")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def _fits(folder: Path) -> bool:
    return (folder / _FILE).is_file()


def _read(folder: Path, given: bool) -> Listing:
    file = folder / _FILE
    data = read_json(file)
    entries = data.get("frames")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise OcnfError("not a list of frames", where=file, field="frames")
    notes = left_out("frame", "without depth_file_path", [f"frames[{i}]" for i in range(len(entries))],
                     [not entry.get("depth_file_path") for entry in entries])
    frames = [_frame(folder, file, data, entry, i, given) for i, entry in enumerate(entries)
              if entry.get("depth_file_path")]
    if not frames:
        raise OcnfError("no frame has depth", code="empty", where=file, found=f"{len(entries)} frames",
                        expected="depth_file_path in each",
                        fix="capture with a depth camera (LiDAR), or convert with depth")
    scale = check_scale(data.get("applied_scale", 1.0), file, "applied_scale")
    if scale != 1.0:
        undone = f"{1 / scale:.9g}"
        notes.append(f"the file says that its poses were scaled by {scale:g} (applied_scale), so that they "
                     f"are not in metres: the pose scale {undone} undoes it (--pose-scale {undone})")
    return Listing(tuple(frames), axes=Axes.OPENGL, notes=(*_distortion(data, entries), *notes),
                   intrinsics="fl_x, fl_y, cx and cy belong into transforms.json, or give FX,FY,CX,CY")


def _frame(folder: Path, file: Path, data: dict[str, Any], entry: dict[str, Any], i: int,
           given: bool) -> Frame:
    depth = below(folder, file, entry["depth_file_path"], f"frames[{i}].depth_file_path")
    pose = json_array(entry.get("transform_matrix"), (4, 4), file, f"frames[{i}].transform_matrix")
    colour = entry.get("file_path")
    image = None if not colour else _image_file(below(folder, file, colour, f"frames[{i}].file_path"))
    K, K_colour = own_intrinsics(lambda: _intrinsics(file, {**data, **entry}, depth, image, i),
                                 given) or (None, None)
    return Frame(str(entry["depth_file_path"]), depth, pose, file, K, image, K_colour)


def _image_file(named: Path) -> Path:
    """The image of that name: Blender's scripts leave the suffix out."""
    if named.is_file():
        return named
    whole = [named.with_name(named.name + suffix) for suffix in _SUFFIXES]
    return next((file for file in whole if file.is_file()), named)


def _intrinsics(file: Path, camera: dict[str, Any], depth: Path, image: Path | None,
                i: int) -> tuple[F64 | None, F64 | None]:
    """K of the depth map, and of the colour image."""
    model = camera.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise OcnfError("not a pinhole camera", where=file, field="camera_model", found=model,
                        expected=" or ".join(_MODELS))
    width, height, shown = camera.get("w"), camera.get("h"), _readable(image)
    size: tuple[int, int] | None
    if isinstance(width, int | float) and isinstance(height, int | float) and 0 < width * height < 1e12:
        size = int(height), int(width)
    else:
        size = shown
    values = [camera.get(name) for name in ("fl_x", "fl_y", "cx", "cy")]
    angle = _angle(camera.get("camera_angle_x")) if values[0] is None else None
    if angle is None and (values[0] is None or values[2] is None or values[3] is None):
        return None, None
    if size is None:
        raise OcnfError("the intrinsics are for images of an unknown size", code="missing", where=file,
                        field=f"frames[{i}]", expected="w and h, or the images",
                        fix="add w and h, or give the intrinsics of the depth as FX,FY,CX,CY")
    if angle is not None:
        upright = _angle(camera.get("camera_angle_y"))
        angles = [_focal(size[1], angle), None if upright is None else _focal(size[0], upright),
                  size[1] / 2, size[0] / 2]
        values = [each if value is None else value for value, each in zip(values, angles, strict=True)]
    if values[1] is None:
        values[1] = values[0]
    fx, fy, cx, cy = json_array(values, (4,), file, f"frames[{i}]: fl_x, fl_y, cx, cy")
    K = pinhole(fx, fy, cx - 0.5, cy - 0.5)
    measured = image_size(depth)
    if not same_shape(size, measured):
        raise OcnfError("the depth map is not the image scaled", where=depth,
                        found="{1}x{0}".format(*measured), expected="the shape of {1}x{0}".format(*size),
                        fix=f"correct w and h in {file.name}, or give the depth's intrinsics as FX,FY,CX,CY")
    fits = shown is not None and same_shape(size, shown)
    return resized(K, size, measured), resized(K, size, shown) if shown is not None and fits else None


def _angle(value: Any) -> float | None:
    """An angle in radians that a picture can take up; None of anything else."""
    return float(value) if isinstance(value, int | float) and 0 < value < math.pi else None


def _focal(length: int, angle: float) -> float:
    """Focal length in pixels where so many pixels take up the angle."""
    return 0.5 * length / math.tan(0.5 * angle)


def _readable(image: Path | None) -> tuple[int, int] | None:
    """(H, W); None of an image that cannot be read, which is left out with a note when frames are loaded."""
    try:
        return None if image is None else image_size(image)
    except OcnfError:
        return None


def _distortion(data: dict[str, Any], entries: list[dict[str, Any]]) -> list[str]:
    values: list[Any] = []
    for camera in (data, *entries):
        listed = camera.get("distortion_params")
        values += [*(camera.get(name) for name in _DISTORTION), *(listed if isinstance(listed, list) else [])]
    largest = max((abs(float(value)) for value in values if isinstance(value, int | float)), default=0.0)
    if largest == 0 or not np.isfinite(largest):
        return []
    return [f"the lens has distortion (coefficients up to {largest:.2g}), which is not applied"]


TRANSFORMS = ScanFormat("transforms", "transforms.json whose frames have depth_file_path", _fits, _read)
