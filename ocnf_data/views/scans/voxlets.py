"""A scene of the Voxlets tabletop set (Firman et al. 2016).

    poses/N.yaml          `image` and `rgb` (paths), `depth_scaling`, `intrinsics` (K by rows), `pose`
                          (4x4 by rows, camera to world, metres, in the coordinates of the grid)
    frames/N.pgm          16 bits, big-endian; metres = value * depth_scaling / 65536; 0 is no measurement
    tsdf_meta.yaml        the grid of the ground truth: `shape` and `voxelsize`

The YAML files carry `!!python/tuple`; that tag alone is accepted.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.files.strict_yaml import read_yaml
from ocnf_data.views.scans.images import image_size
from ocnf_data.views.scans.listing import (
    Frame,
    Listing,
    ScanFormat,
    below,
    names_in,
    numbered,
    own_intrinsics,
)
from ocnf_data.views.scans.text import json_array

_SCALED = 65536  # a value of this many units is `depth_scaling` metres


def _fits(folder: Path) -> bool:
    return any(name.endswith(".pgm") for name in names_in(folder / "frames"))


def _read(folder: Path, given: bool) -> Listing:
    files = numbered(folder / "poses", {".yaml"})
    if not files:
        raise OcnfError("has no poses", code="missing", where=folder, expected="poses/*.yaml")
    frames, scalings = [], set()
    for file in files.values():
        data = _mapping(file)
        depth = _image(folder, file, data, "image")
        assert depth is not None
        colour = _image(folder, file, data, "rgb")
        scaling = data.get("depth_scaling")
        if not isinstance(scaling, int | float) or not np.isfinite(scaling) or scaling <= 0:
            raise OcnfError("not a depth scaling", where=file, field="depth_scaling", found=scaling)
        scalings.add(float(scaling))
        K = own_intrinsics(partial(json_array, data.get("intrinsics"), (3, 3), file, "intrinsics"), given)
        frames.append(Frame(depth.stem, depth, json_array(data.get("pose"), (4, 4), file, "pose"), file, K,
                            colour))
    if len(scalings) > 1:
        raise OcnfError("the frames differ in their depth scaling", where=folder, found=sorted(scalings))
    return Listing(tuple(frames), unit=scalings.pop() / _SCALED, cube=_cube(folder))


def _mapping(file: Path) -> dict[str, Any]:
    data = read_yaml(file, tuples=True)
    if not isinstance(data, dict):
        raise OcnfError("not a mapping", where=file, found=type(data).__name__)
    return data


def _image(folder: Path, file: Path, data: dict[str, Any], field: str) -> Path | None:
    try:
        place = below(folder, file, data.get(field), field)
        if field != "rgb":
            image_size(place)
    except OcnfError:
        if field == "rgb":
            return None
        raise
    return place


def _cube(folder: Path) -> tuple[tuple[float, float, float], float] | None:
    """The smallest cube about the grid of the ground truth; None where that is not there."""
    file = folder / "tsdf_meta.yaml"
    if not file.is_file():
        return None
    data = _mapping(file)
    shape = json_array(data.get("shape"), (3,), file, "shape")
    voxel = json_array([data.get("voxelsize")], (1,), file, "voxelsize")
    x, y, z = (shape * voxel).tolist()
    if not (np.isfinite([x, y, z]).all() and min(x, y, z) > 0):
        raise OcnfError("not a grid", where=file, found=(x, y, z), expected="lengths above 0")
    return (x / 2, y / 2, z / 2), max(x, y, z)


VOXLETS = ScanFormat("voxlets", "frames/*.pgm and poses/*.yaml", _fits, _read)
