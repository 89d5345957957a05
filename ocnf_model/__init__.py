"""OctNetFusion: learned fusion of depth on grid-octrees.

Public names resolve on first use. Nothing here needs trimesh, pyrender or OpenGL.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_HOME = {
    "OctNetFusion": "network",
    "OctreeBatch": "octree.batch",
    "OctreeConv3d": "ops",
    "Reconstruction": "scan.reconstruction",
    "TrainedNetwork": "scan.load",
    "concat": "ops",
    "grid_pool": "ops",
    "grid_unpool": "ops",
    "load_network": "scan.load",
    "split_surface": "ops",
}

__all__ = [
    "OctNetFusion",
    "OctreeBatch",
    "OctreeConv3d",
    "Reconstruction",
    "TrainedNetwork",
    "concat",
    "grid_pool",
    "grid_unpool",
    "load_network",
    "split_surface",
]

if TYPE_CHECKING:
    from ocnf_model.network import OctNetFusion
    from ocnf_model.octree.batch import OctreeBatch
    from ocnf_model.ops import OctreeConv3d, concat, grid_pool, grid_unpool, split_surface
    from ocnf_model.scan.load import TrainedNetwork, load_network
    from ocnf_model.scan.reconstruction import Reconstruction


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ocnf_model' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"ocnf_model.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
