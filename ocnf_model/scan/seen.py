"""Which parts of a grid lie near something that was measured: all others hold walls around the unseen alone.

Between what is seen and what is not, every reconstruction has walls, which are left out of the mesh in the
end (`region.observed`). They are ten times as large as the surfaces, so they are not cut out at all.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ocnf_data.arrays import F32, F64, Bool
from ocnf_data.views.cameras import Views
from ocnf_model.scan.region import Region

_TREE = 8


def measured_trees(views: Views, region: Region, shape: tuple[int, int, int], band: float) -> Bool:
    """The trees (D / 8, H / 8, W / 8) of a grid in which a vertex can be that `observed` keeps.

    Args:
        views: the depth maps.
        region: the grid's centre, and in `size` the length of its longest axis.
        shape: voxels (D, H, W) of the grid.
        band: metres, as for `observed`.
    """
    voxel = region.size / max(shape)
    marked = np.zeros([n // _TREE for n in shape], np.bool_)
    first = np.array(region.centre) - voxel * np.array(shape[::-1]) / 2
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        _mark(depth, K, np.column_stack([R, T]), np.array([*first, voxel * _TREE, band, voxel]), marked)
    return marked


@njit(cache=True, nogil=True)
def _mark(depth: F32, K: F64, pose: F64, grid: F64, marked: Bool) -> None:
    """Mark the trees that lie as near to the points of a depth map as `observed` looks around a vertex.

    `grid`: low corner x, y, z, width of a tree, band and width of a voxel, metres.
    """
    tree, band, voxel = grid[3], grid[4], grid[5]
    R, T = pose[:, :3], pose[:, 3]
    for row in range(depth.shape[0]):
        y = (row - K[1, 2]) / K[1, 1]
        for column in range(depth.shape[1]):
            z = np.float64(depth[row, column])
            if not 0 < z < np.inf:
                continue
            x = (column - K[0, 2]) / K[0, 0]
            # Along its ray a point may be a band away in z; across it one pixel and a half. Cells reach from
            # a voxel to the next.
            reach = band * np.sqrt(1 + x * x + y * y) + 1.6 * (z + band) / min(K[0, 0], K[1, 1]) + 2 * voxel
            a, b, c = x * z - T[0], y * z - T[1], z - T[2]
            low, high = np.empty(3, np.int64), np.empty(3, np.int64)
            inside = True
            for axis in range(3):
                at = R[0, axis] * a + R[1, axis] * b + R[2, axis] * c - grid[axis]
                n = marked.shape[2 - axis]
                low[axis] = max(int(np.floor((at - reach) / tree)), 0)
                high[axis] = min(int(np.floor((at + reach) / tree)), n - 1)
                inside = inside and low[axis] <= high[axis]
            if not inside:
                continue
            for i in range(low[2], high[2] + 1):
                for j in range(low[1], high[1] + 1):
                    for k in range(low[0], high[0] + 1):
                        marked[i, j, k] = True
