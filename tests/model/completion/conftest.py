"""A table with a box and a cylinder on it, seen by one camera, and its exact ground truth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from ocnf_data.render import render_depth
from ocnf_data.views.cameras import Views
from ocnf_data.views.rigs import intrinsics
from ocnf_model.completion.tabletop import Tabletop

VOXEL = 0.01  # metres
SHAPE = (30, 40, 50)  # (D, H, W)
TOP = 0.05  # metres: height of the table's top
BOX = np.array([[0.08, 0.1, TOP], [0.2, 0.22, 0.2]])  # low and high corner, metres
CENTRE, RADIUS, HIGHEST = np.array([0.36, 0.2]), 0.06, 0.17  # of the cylinder


def centres(shape: tuple[int, int, int] = SHAPE) -> tuple[np.ndarray, ...]:
    """x, y, z in metres of each voxel's centre, (D, H, W) each."""
    z, y, x = ((np.indices(shape)[i] + 0.5) * VOXEL for i in range(3))
    return x, y, z


def truth() -> np.ndarray:
    """(D, H, W) distances of the right sign: of the table, the box and the cylinder."""
    x, y, z = centres()
    table = z - TOP
    box = np.maximum.reduce([BOX[0, 0] - x, x - BOX[1, 0], BOX[0, 1] - y, y - BOX[1, 1],
                             BOX[0, 2] - z, z - BOX[1, 2]])
    cylinder = np.maximum(np.hypot(x - CENTRE[0], y - CENTRE[1]) - RADIUS, z - HIGHEST)
    return np.minimum.reduce([table, box, cylinder]).astype(np.float32)


def camera(eye: tuple[float, float, float],
           target: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """World to camera (R, T), x level."""
    z = np.subtract(target, eye)
    z = z / np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return R, -R @ np.array(eye)


@pytest.fixture(scope="session")
def tabletop() -> Callable[..., Tabletop]:
    """Makes the scene, seen from a place of choice."""
    parts = [trimesh.creation.box(bounds=[[-1, -1, 0], [1.5, 1.4, TOP]]), trimesh.creation.box(bounds=BOX),
             trimesh.creation.cylinder(RADIUS, segment=[[*CENTRE, TOP], [*CENTRE, HIGHEST]], sections=96)]
    mesh = trimesh.util.concatenate(parts)

    def make(eye: tuple[float, float, float] = (0.25, -0.5, 0.55)) -> Tabletop:
        R, T = camera(eye, (0.25, 0.2, 0.08))
        K = intrinsics(280, 280, 160, 120)
        depth = render_depth(mesh.vertices, mesh.faces, K, R[None], T[None], (240, 320))
        return Tabletop("made", Views(depth, K, R[None], T[None]), VOXEL, truth())

    return make


@pytest.fixture(scope="session")
def inside() -> dict[str, np.ndarray]:
    """Voxels (D, H, W) at least two from the faces of the box and the cylinder."""
    x, y, z = centres()
    low, high = BOX[0] + 2 * VOXEL, BOX[1] - 2 * VOXEL
    box = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1]) & (z < high[2])
    cylinder = (np.hypot(x - CENTRE[0], y - CENTRE[1]) < RADIUS - 2 * VOXEL) & (z < HIGHEST - 2 * VOXEL)
    return {"box": box & (z > TOP + VOXEL), "cylinder": cylinder & (z > TOP + VOXEL)}
