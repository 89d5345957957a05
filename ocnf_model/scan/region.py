"""Which part of a scan is fused, and which part of the result was seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, F64, Bool, as_numbers
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid
from ocnf_data.sequences.cube import measured_bounds, measured_points, object_box
from ocnf_data.views.cameras import Views

_PADDING = 0.05  # of the cube is free on both sides together, as around the meshes of training
_ROOM_MARGIN = 0.02  # of each axis, added at both ends
_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])  # of a box
_EDGES = np.array([(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])  # (12, 2) corners


@dataclass(frozen=True)
class Region:
    """A box of the scan, and the cube around it that is fused.

    Attributes:
        low, high: corners (x, y, z) of the box in metres: surfaces beyond are cut off.
        size: edge length of the cube in metres, whose centre is the box's; where voxels of a chosen size fill
            a grid that is no cube, the length of its longest axis.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    size: float

    @classmethod
    def of_cube(cls, centre: tuple[float, float, float], size: float) -> Region:
        """The region that is all of a cube."""
        x, y, z = centre
        half = size / 2
        return cls((x - half, y - half, z - half), (x + half, y + half, z + half), size)

    @classmethod
    def of_box(cls, box: Sequence[float]) -> Region:
        """The region x0 y0 z0 x1 y1 z1 in metres. Its longest edge takes 95 % of the cube, as in training.

        Raises:
            OcnfError: not six finite numbers, or a corner that is not below the other.
        """
        corners = as_numbers(box, "fuse", "box", np.float64)
        if corners.shape != (6,) or not np.isfinite(corners).all() or (corners[3:] <= corners[:3]).any():
            raise OcnfError("not a box", field="box", found=" ".join(map(str, np.ravel(corners))),
                            expected="x0 y0 z0 x1 y1 z1 in metres, x0 < x1, y0 < y1, z0 < z1")
        x0, y0, z0, x1, y1, z1 = corners.tolist()
        return cls((x0, y0, z0), (x1, y1, z1), max(x1 - x0, y1 - y0, z1 - z0) / (1 - _PADDING))

    @property
    def centre(self) -> tuple[float, float, float]:
        """The centre of box and cube, (x, y, z) in metres."""
        x, y, z = ((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))
        return x, y, z

    def __str__(self) -> str:
        """The box as `--box` takes it, to a tenth of a millimetre, and of one below 0.1 m more finely."""
        longest = float(np.subtract(self.high, self.low).max())
        digits = min(max(4, 3 - math.floor(math.log10(longest))), 15)  # after the point
        return "box " + " ".join(f"{round(c, digits) + 0.0:.15g}" for c in (*self.low, *self.high))  # no -0

    def holds(self, points: F64) -> Bool:
        """Which of the points (N, 3) lie in the box."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1))


def everything(views: Views | DepthPyramid) -> Region:
    """The box around all that the frames measured, but for stray points: a room, seen from inside.

    Of each axis, 0.2 % of the points at either end do not count; then 2 % of the length are added.

    Raises:
        OcnfError: nothing was measured (`empty`).
    """
    low, high = measured_bounds(measured_points(views.views if isinstance(views, DepthPyramid) else views))
    margin = _ROOM_MARGIN * np.maximum(high - low, 1e-6)
    return Region.of_box([*(low - margin), *(high + margin)])


def largest_object(views: Views | DepthPyramid) -> Region:
    """The box around the largest connected surface.

    All views are fused into a coarse TSDF (128 voxels) over the bounds of all measured points. A voxel
    belongs to a surface where the TSDF is neither free nor unseen: within 2.13 voxels of what was measured.
    Voxels that touch, if only at a corner, belong together, and the largest is the one of most voxels. What
    an object stands on is part of it: an object on a table needs a box of its own.

    Raises:
        OcnfError: nothing was measured (`empty`).
    """
    return Region.of_box(object_box(views))


def looked_at(views: Views, region: Region) -> bool:
    """Whether some part of a region's box lies in the picture of some frame, whatever was measured there.

    A box and the cone of a picture, both convex, meet where an edge of one runs through the other.
    """
    low, high = np.array(region.low), np.array(region.high)
    height, width = views.size
    fx, fy, cx, cy = (views.K[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))  # (V, 1)
    x, y, z = np.moveaxis((low + _CORNERS * (high - low)) @ views.R.transpose(0, 2, 1) + views.T[:, None],
                          -1, 0)  # (V, 8)
    within = np.stack([fx * x + (cx + 0.5) * z, (width - 0.5 - cx) * z - fx * x,  # the picture's four sides
                       fy * y + (cy + 0.5) * z, (height - 0.5 - cy) * z - fy * y], axis=-1)  # (V, 8, 4)
    a, b = within[:, _EDGES[:, 0]], within[:, _EDGES[:, 1]]  # (V, 12, 4) at both ends of the box's edges
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = a / (a - b)
    enters = np.where(a >= 0, 0.0, np.where(b >= 0, crossing, np.inf)).max(axis=-1)
    leaves = np.where(b >= 0, 1.0, np.where(a >= 0, crossing, -np.inf)).min(axis=-1)
    if (enters <= leaves).any():
        return True
    u, v = np.array([-0.5, -0.5, width - 0.5, width - 0.5]), np.array([-0.5, height - 0.5] * 2)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u - cx)], axis=-1) @ views.R  # (V, 4, 3)
    rays[rays == 0] = np.finfo(np.float64).tiny
    centres = -np.einsum("vij,vi->vj", views.R, views.T)[:, None]
    with np.errstate(over="ignore"):
        ends = np.stack([(low - centres) / rays, (high - centres) / rays])
    nearest, farthest = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    return bool((farthest >= np.maximum(nearest, 0)).any())


def observed(points: F64, views: Views, band: float) -> Bool:
    """Which of the points (N, 3) some view has measured a surface at, to within `band` metres along its axis.

    What no view sees counts as solid in all methods, so that every reconstruction is closed by walls along
    the edges of what was seen; this tells them from surfaces. The measurement is that of the pixel which the
    point projects to, or of one beside it: noise moves each pixel by itself, and rarely all nine.
    """
    seen = np.zeros(len(points), np.bool_)
    _mark_observed(np.ascontiguousarray(points), views.depth, views.K, views.R, views.T, band, seen)
    return seen


@njit(cache=True, nogil=True, parallel=True)
def _mark_observed(points: F64, depth: F32, K: F64, R: F64, T: F64, band: float,
                   seen: Bool) -> None:
    n_views, height, width = depth.shape
    for i in prange(len(points)):
        p = points[i]
        for view in range(n_views):
            r, t, k = R[view], T[view], K[view]
            z = r[2, 0] * p[0] + r[2, 1] * p[1] + r[2, 2] * p[2] + t[2]
            if z <= 0:
                continue
            x = r[0, 0] * p[0] + r[0, 1] * p[1] + r[0, 2] * p[2] + t[0]
            y = r[1, 0] * p[0] + r[1, 1] * p[1] + r[1, 2] * p[2] + t[1]
            u, v = np.floor(k[0, 0] * x / z + k[0, 2] + 0.5), np.floor(k[1, 1] * y / z + k[1, 2] + 0.5)
            if not (-1 <= u <= width and -1 <= v <= height):
                continue
            for row in range(max(int(v) - 1, 0), min(int(v) + 2, height)):
                for column in range(max(int(u) - 1, 0), min(int(u) + 2, width)):
                    measured = depth[view, row, column]
                    if measured > 0 and abs(measured - z) <= band:
                        seen[i] = True
            if seen[i]:
                break
