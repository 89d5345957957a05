"""OpenVDB grids: level sets that Houdini, Blender and other programs read.

OpenVDB's Python module is not on PyPI: `conda install -c conda-forge openvdb`, or `python3-openvdb` of Debian
and Ubuntu. Older versions call it `pyopenvdb`.
"""

from __future__ import annotations

import importlib
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.export.points import surface_radius
from ocnf_data.export.sample import ExportSample
from ocnf_data.export.settings import Coordinates
from ocnf_data.octree import TARGET, GridOctree

_MODULES = ("openvdb", "pyopenvdb")


def openvdb() -> Any:
    """OpenVDB's Python module.

    Raises:
        OcnfError: code `missing_extra` where it is not installed.
    """
    failures = []
    for name in _MODULES:
        try:
            return importlib.import_module(name)
        except ImportError as error:  # missing, or built for another numpy
            failures.append(str(error))
    raise OcnfError("OpenVDB grids need OpenVDB's Python module, which is not on PyPI (Debian has it as "
                    "python3-openvdb)", code="missing_extra", where="export", field="format",
                    found="; ".join(failures), fix="conda install -c conda-forge openvdb")


def vdb_grids(sample: ExportSample) -> list[Any]:
    """One `openvdb.FloatGrid` for the ground truth, `target`, and one for each TSDF input, by its variant.

    Index (i, j, k) runs along x, y, z; the transform takes it to the centre of the voxel. A TSDF is a level
    set: distances in the units of the coordinates, with tau as background, so free space takes no memory.
    Occupancy is a fog volume of 0 and 1.
    """
    vdb = openvdb()
    truth = sample.octree(sample.target)
    distance = truth if sample.is_tsdf else truth.with_data(1 - 2 * truth.data)
    frame = sample.frame(Coordinates.METRES, partial(surface_radius, distance, sample.extent))
    octrees = {TARGET: truth, **{name: sample.octree(member) for name, member in sample.tsdf_inputs.items()}}
    return [_grid(vdb, name, octree, sample.extent * frame.factor,
                  sample.truncation * frame.factor if name != TARGET or sample.is_tsdf else None)
            for name, octree in octrees.items()]


def vdb_files(sample: ExportSample) -> dict[str, bytes]:
    """The files of a sample: one `.vdb` with all its grids."""
    with tempfile.TemporaryDirectory(prefix="ocnf-") as folder:
        path = Path(folder) / "grids.vdb"
        openvdb().write(str(path), grids=vdb_grids(sample))
        return {f"{sample.stored.split}/{sample.key}.vdb": path.read_bytes()}


def _grid(vdb: Any, name: str, octree: GridOctree, extent: float, tau: float | None) -> Any:
    """A grid over a cube of side `extent`; `tau` None is occupancy."""
    size = extent / max(octree.shape)
    background = np.float32(0 if tau is None else tau)
    values = octree.to_dense()[0] * np.float32(1 if tau is None else tau)
    grid = vdb.FloatGrid(float(background))
    grid.name = name
    grid.gridClass = vdb.GridClass.FOG_VOLUME if tau is None else vdb.GridClass.LEVEL_SET
    grid.copyFromArray(np.ascontiguousarray(values.transpose(2, 1, 0)))
    first = [0.5 * size * (1 - n) for n in octree.shape[::-1]]  # centre of voxel (0, 0, 0)
    grid.transform = vdb.createLinearTransform(  # of rows (i, j, k, 1)
        [[size, 0, 0, 0], [0, size, 0, 0], [0, 0, size, 0], [*first, 1]])
    return grid
