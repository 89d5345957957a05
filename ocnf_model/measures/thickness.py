"""Local thickness of a solid at points of its surface."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, F64
from ocnf_data.octree import GridOctree

_FINE, _COARSE = 0.25, 0.5  # steps in voxels, up to _FINE_UNTIL and beyond
_FINE_UNTIL = 3.0
_REACH = 1.0  # voxels before and behind the point in which the solid may begin


def local_thickness(truth: GridOctree, points: F64, normals: F64, longest: float,
                    extent: float = 3.0) -> F64:
    """How long the line through a point of the surface, along its normal, stays inside the solid.

    The line is followed inwards, to the side on which the TSDF is lower one voxel away. It enters the solid
    (TSDF, linearly interpolated, below 0) within a voxel of the point, at the crossing nearest to it, and the
    thickness is the way from there to where it leaves. So a plate has its thickness everywhere but on its
    rim, a rod its diameter, a sphere its diameter. 0 where the solid does not begin there: what the grid
    cannot hold, such as a sheet without volume.

    Args:
        truth: TSDF / tau, 1 channel, negative inside, finest resolution that there is.
        points: (N, 3) of the surface, x y z, metres, the grid's centre being the origin.
        normals: (N, 3) of length 1; which way they point does not matter.
        longest: length in metres after which the line is not followed.
        extent: size of the longest axis of the grid in metres.

    Returns:
        (N,) metres, infinite where the line is still inside after `longest`.
    """
    size = extent / max(truth.shape)
    middle = (np.array(truth.shape[::-1]) - 1) / 2
    volume = truth.to_dense()[0]
    return size * _follow(volume, points / size + middle, np.ascontiguousarray(normals), longest / size)


@njit(cache=True, nogil=True, parallel=True)
def _follow(volume: F32, points: F64, normals: F64, longest: float) -> F64:
    """`local_thickness` in voxels; `points` are x y z, whole numbers at voxel centres."""
    found = np.zeros(len(points))
    for n in prange(len(points)):
        point, way = points[n], normals[n]
        sign = 1.0 if _value(volume, point, way, 1.0) <= _value(volume, point, way, -1.0) else -1.0
        enters, distance = np.nan, np.inf
        before = _value(volume, point, way, -sign * _REACH)
        steps = int(2 * _REACH / _FINE)
        for step in range(1, steps + 1):
            t = step * _FINE - _REACH
            value = _value(volume, point, way, sign * t)
            if before >= 0 > value:
                crossing = t - _FINE * value / (value - before)
                if abs(crossing) < distance:
                    enters, distance = crossing, abs(crossing)
            before = value
        if np.isnan(enters):
            if _value(volume, point, way, 0.0) >= 0:
                continue
            enters = -_REACH  # the point lies deeper inside than that
        found[n] = np.inf
        t, before = enters, np.float64(-1e-6)
        while t < enters + longest:
            step_length = _FINE if t < enters + _FINE_UNTIL else _COARSE
            value = _value(volume, point, way, sign * (t + step_length))
            if value >= 0:
                found[n] = t + step_length * before / (before - value) - enters
                break
            before = value
            t += step_length
    return found


@njit(cache=True, nogil=True)
def _value(volume: F32, point: F64, way: F64, t: float) -> float:
    """The volume at point + t way, trilinear; 1 outside."""
    depth, height, width = volume.shape
    x, y, z = point[0] + t * way[0], point[1] + t * way[1], point[2] + t * way[2]
    x0, y0, z0 = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    total = 0.0
    for k in range(8):
        i, j, h = x0 + (k & 1), y0 + (k >> 1 & 1), z0 + (k >> 2)
        inside = i >= 0 and j >= 0 and h >= 0 and i < width and j < height and h < depth
        share = (1 - abs(x - i)) * (1 - abs(y - j)) * (1 - abs(z - h))
        total += share * (np.float64(volume[h, j, i]) if inside else 1.0)
    return total
