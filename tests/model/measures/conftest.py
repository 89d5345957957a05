"""Solids with known distances, as TSDF octrees of a cube of 3 m."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ocnf_data.octree import GridOctree

RESOLUTION = 64
VOXEL = 3 / RESOLUTION
TAU = 32 / 15 * VOXEL


def coordinates(resolution: int = RESOLUTION) -> tuple[np.ndarray, ...]:
    """x, y, z of the voxel centres, each (D, H, W), in metres."""
    centres = (np.arange(resolution) + 0.5) * 3 / resolution - 1.5
    z, y, x = np.meshgrid(centres, centres, centres, indexing="ij")
    return x, y, z


def of_distance(distance: np.ndarray) -> GridOctree:
    """A signed distance in metres as an octree of TSDF / tau."""
    return GridOctree.from_dense(np.clip(distance / TAU, -1, 1).astype(np.float32)[None])


@pytest.fixture(scope="session")
def solid() -> Callable[..., GridOctree]:
    """`solid(distance)` with `distance(x, y, z)` in metres."""
    return lambda distance: of_distance(distance(*coordinates()))


@pytest.fixture(scope="session")
def voxel() -> float:
    """Metres."""
    return VOXEL
