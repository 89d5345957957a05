"""The voxel grid as each camera sees it: projection as an affine map of voxel indices.

Voxel (iz, iy, ix) has its centre at `centre + (i + 0.5) * s - n * s / 2` on each axis (SEMANTICS 1). In the
camera, (fx X, fy Y, Z) is affine in (ix, iy, iz), so that a pixel costs two multiplications and one
reciprocal: u + 0.5 = fx X / Z + (cx + 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.views.cameras import Views

CELL = 4
"""Voxels along each axis of the smallest cube that is classified; voxels are evaluated a cube at a time."""


@dataclass(frozen=True)
class Grid:
    """A box of D x H x W cubic voxels.

    Attributes:
        shape: (D, H, W), multiples of 8.
        voxel: edge length of a voxel in metres.
        centre: world position (x, y, z) of the box's centre in metres.
    """

    shape: tuple[int, int, int]
    voxel: float
    centre: tuple[float, float, float]


def grid_cameras(views: Views, grid: Grid) -> F64:
    """Cameras on voxel indices, (V, 14).

    Columns 0-3, 4-7, 8-11: coefficients of (ix, iy, iz, 1) in fx X, fy Y and Z; 12, 13: cx + 0.5, cy + 0.5.
    """
    d, h, w = grid.shape
    first = np.array(grid.centre) + (0.5 - 0.5 * np.array([w, h, d])) * grid.voxel  # its centre, xyz
    start = views.R @ first + views.T
    affine = np.concatenate([views.R * grid.voxel, start[:, :, None]], axis=2)  # (V, 3, 4)
    affine[:, 0] *= views.K[:, 0, 0, None]
    affine[:, 1] *= views.K[:, 1, 1, None]
    return np.concatenate([affine.reshape(-1, 12), views.K[:, :2, 2] + 0.5], axis=1)


def cell_offsets(cameras: F64) -> F64:
    """What the voxels of a cell, (z, y, x) in C order, add to its first's (fx X, fy Y, Z): (V, 3, 64)."""
    z, y, x = np.indices((CELL, CELL, CELL)).reshape(3, 1, 1, -1)
    rows = cameras[:, :12].reshape(-1, 3, 4, 1)
    return rows[:, :, 0] * x + rows[:, :, 1] * y + rows[:, :, 2] * z
