"""Data sets in the formats of other projects: volumes, point samples, meshes, OpenVDB grids (docs/export.md).

`export_dataset` writes a whole data set, as `ocnf-data export` does. The functions it is made of take one
octree or one sample each, and are in a module for each format. Names resolve on first use: the command line
needs the names of the formats for `--help`, and no more.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ocnf_data.export.dense import dense_arrays
    from ocnf_data.export.mesh import surface_meshes
    from ocnf_data.export.points import occupancy_points, sdf_samples, surface_points, tsdf_at
    from ocnf_data.export.run import ExportReport, export_dataset
    from ocnf_data.export.sample import ExportSample
    from ocnf_data.export.settings import Coordinates, ExportFormat, ExportSettings
    from ocnf_data.export.vdb import vdb_grids

__all__ = [
    "Coordinates",
    "ExportFormat",
    "ExportReport",
    "ExportSample",
    "ExportSettings",
    "dense_arrays",
    "export_dataset",
    "occupancy_points",
    "sdf_samples",
    "surface_meshes",
    "surface_points",
    "tsdf_at",
    "vdb_grids",
]

_HOME = {
    "Coordinates": "settings",
    "ExportFormat": "settings",
    "ExportReport": "run",
    "ExportSample": "sample",
    "ExportSettings": "settings",
    "dense_arrays": "dense",
    "export_dataset": "run",
    "occupancy_points": "points",
    "sdf_samples": "points",
    "surface_meshes": "mesh",
    "surface_points": "points",
    "tsdf_at": "points",
    "vdb_grids": "vdb",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ocnf_data.export' has no attribute {name!r}")
    return getattr(importlib.import_module(f"ocnf_data.export.{_HOME[name]}"), name)
