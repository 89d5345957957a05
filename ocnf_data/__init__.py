"""Grid-octree training data from meshes and posed depth scans.

Public names resolve on first use, so `import ocnf_data` loads neither torch nor trimesh nor OpenGL.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from ocnf_data.version import __version__

_HOME = {
    "GridOctree": "octree",
    "MixtureDataset": "loading.mixture",
    "OcnfError": "errors",
    "Report": "generation",
    "Scan": "views.scans",
    "ShardDataset": "loading.dataset",
    "SynthesisDataset": "synthesis.dataset",
    "Views": "views.cameras",
    "fuse_histogram": "fusion",
    "fuse_occupancy": "fusion",
    "fuse_tdf_occupancy": "fusion",
    "fuse_tsdf": "fusion",
    "generate": "generation",
    "load_manifest": "manifest",
    "octree_surface": "octree.surface",
    "read_scan": "views.scans",
    "render_depth": "render",
}

__all__ = [
    "GridOctree",
    "MixtureDataset",
    "OcnfError",
    "Report",
    "Scan",
    "ShardDataset",
    "SynthesisDataset",
    "Views",
    "__version__",
    "fuse_histogram",
    "fuse_occupancy",
    "fuse_tdf_occupancy",
    "fuse_tsdf",
    "generate",
    "load_manifest",
    "octree_surface",
    "read_scan",
    "render_depth",
]

if TYPE_CHECKING:
    from ocnf_data.errors import OcnfError
    from ocnf_data.fusion import fuse_histogram, fuse_occupancy, fuse_tdf_occupancy, fuse_tsdf
    from ocnf_data.generation import Report, generate
    from ocnf_data.loading.dataset import ShardDataset
    from ocnf_data.loading.mixture import MixtureDataset
    from ocnf_data.manifest import load_manifest
    from ocnf_data.octree import GridOctree
    from ocnf_data.octree.surface import octree_surface
    from ocnf_data.render import render_depth
    from ocnf_data.synthesis.dataset import SynthesisDataset
    from ocnf_data.views.cameras import Views
    from ocnf_data.views.scans import Scan, read_scan


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ocnf_data' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"ocnf_data.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
