"""The dense comparison for fusion: every voxel of every view, as well as numba does it.

Parallel over z slices, the camera's matrices in registers, depth maps read in place, no temporaries, one
pass over the volume. Gives the TSDF of SEMANTICS 2 as a dense volume; no octree is made of it.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, F64
from ocnf_data.fusion import default_truncation
from ocnf_data.views.cameras import Views


def dense_tsdf(views: Views, resolution: int, extent: float = 3.0) -> F32:
    """TSDF / tau as a dense (D, H, W) float32 volume, on numba's number of threads."""
    volume = np.empty((resolution,) * 3, np.float32)
    _integrate(views.depth, views.K, views.R, views.T, extent, default_truncation(resolution, extent), volume)
    return volume


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def _integrate(depth: F32, K: F64, R: F64, T: F64, extent: float, tau: float, volume: F32) -> None:
    n_views, height, width = depth.shape
    size = volume.shape[0]
    voxel = extent / size
    scale = 1.0 / tau
    for iz in prange(size):
        z = (iz + 0.5) * voxel - extent / 2
        total = np.zeros((size, size))
        count = np.zeros((size, size))
        for view in range(n_views):
            image = depth[view]
            fx, fy, cx, cy = K[view, 0, 0], K[view, 1, 1], K[view, 0, 2] + 0.5, K[view, 1, 2] + 0.5
            r00, r01, r02, tx = R[view, 0, 0], R[view, 0, 1], R[view, 0, 2], T[view, 0]
            r10, r11, r12, ty = R[view, 1, 0], R[view, 1, 1], R[view, 1, 2], T[view, 1]
            r20, r21, r22, tz = R[view, 2, 0], R[view, 2, 1], R[view, 2, 2], T[view, 2]
            for iy in range(size):
                y = (iy + 0.5) * voxel - extent / 2
                xs, ys, zs = r01 * y + r02 * z + tx, r11 * y + r12 * z + ty, r21 * y + r22 * z + tz
                for ix in range(size):
                    x = (ix + 0.5) * voxel - extent / 2
                    zc = r20 * x + zs
                    if zc <= 0:
                        continue
                    inverse = 1.0 / zc
                    u = fx * (r00 * x + xs) * inverse + cx
                    v = fy * (r10 * x + ys) * inverse + cy
                    if u >= 0 and v >= 0 and u < width and v < height:
                        measured = image[np.uint64(v), np.uint64(u)]
                        distance = measured - zc
                        if measured > 0 and distance >= -tau:
                            total[iy, ix] += min(distance * scale, 1.0)
                            count[iy, ix] += 1.0
        for iy in range(size):
            for ix in range(size):
                volume[iz, iy, ix] = total[iy, ix] / count[iy, ix] if count[iy, ix] > 0 else -1.0
