"""What a view can say about a cube of voxels, decided from its depth pyramid without touching a voxel.

Conservative: the pixels looked at contain every pixel that a voxel centre of the cube rounds to, so skipping
what is classified never changes a value.
"""

from __future__ import annotations

import math

from numba import njit

from ocnf_data.fusion.pyramid import DEEPEST, FARTHEST, NEAREST

NOTHING = 0
"""No voxel of the cube gets a contribution: hidden, behind the camera, outside the image, not measured."""
FREE = 1
"""Every voxel of the cube is seen to be free."""
SILHOUETTE = 2
"""Each voxel is either seen to be free or gets no contribution; none is near a surface."""
SURFACE = 3
"""Anything else."""
EDGE = 4
"""Added to SILHOUETTE or SURFACE if a voxel may lie outside the image or behind the camera."""

# Far above the rounding of float64 at any coordinate in use, far below what matters.
_PIXEL_SLACK = 1e-6
_METRE_SLACK = 1e-9


@njit(cache=True, nogil=True, error_model="numpy")
def classify(camera, windows, levels, size, z, y, x, half, near, far):
    """Class of one view for the cube of voxel centres within `half` of (z, y, x), in voxels on each axis.

    Args:
        camera: (14,) float64, a row of `frames.grid_cameras`.
        windows, levels: that view's part of the DepthPyramid, (n_entries, 3), and its levels.
        size: image size (H, W).
        near, far: metres; a measured pixel with `depth - z_c < near` contributes nothing, one with
            `depth - z_c >= far` says free.
    """
    height, width = size
    depth = camera[8] * x + camera[9] * y + camera[10] * z + camera[11]
    reach = half * (abs(camera[8]) + abs(camera[9]) + abs(camera[10]))
    nearest, farthest = depth - reach, depth + reach
    if farthest < -_METRE_SLACK:
        return NOTHING
    if nearest < _METRE_SLACK:
        return SURFACE + EDGE
    # With a, b the offsets of (f X, Z) within the cube: (fX + a) / (Z + b) - fX / Z = (a - b fX / Z) / (Z + b),
    # whose numerator is linear in the offset, so its extreme over the cube is an L1 norm.
    tu = (camera[0] * x + camera[1] * y + camera[2] * z + camera[3]) / depth
    tv = (camera[4] * x + camera[5] * y + camera[6] * z + camera[7]) / depth
    ru = abs(camera[0] - tu * camera[8]) + abs(camera[1] - tu * camera[9]) + abs(camera[2] - tu * camera[10])
    rv = abs(camera[4] - tv * camera[8]) + abs(camera[5] - tv * camera[9]) + abs(camera[6] - tv * camera[10])
    ru = half * ru / nearest + _PIXEL_SLACK
    rv = half * rv / nearest + _PIXEL_SLACK
    u, v = tu + camera[12], tv + camera[13]
    u0, u1, v0, v1 = math.floor(u - ru), math.floor(u + ru), math.floor(v - rv), math.floor(v + rv)
    if u1 < 0 or v1 < 0 or u0 >= width or v0 >= height:
        return NOTHING
    edge = 0
    if u0 < 0 or v0 < 0 or u1 >= width or v1 >= height:
        edge = EDGE
        u0, v0, u1, v1 = max(u0, 0), max(v0, 0), min(u1, width - 1), min(v1, height - 1)
    level = 1
    while (u1 >> level) - (u0 >> level) > 3 or (v1 >> level) - (v0 >> level) > 3:
        level += 1
    first, row = levels[level]
    j0, i0 = u0 >> level, v0 >> level
    j1, i1 = max((u1 >> level) - 1, j0), max((v1 >> level) - 1, i0)
    a, b = windows[first + i0 * row + j0], windows[first + i0 * row + j1]
    c, d = windows[first + i1 * row + j0], windows[first + i1 * row + j1]
    if min(min(a[NEAREST], b[NEAREST]), min(c[NEAREST], d[NEAREST])) - farthest >= far + _METRE_SLACK:
        return FREE if edge == 0 else SILHOUETTE + EDGE
    deepest = max(max(a[DEEPEST], b[DEEPEST]), max(c[DEEPEST], d[DEEPEST]))
    if deepest == 0 or deepest - nearest < near - _METRE_SLACK:
        if max(max(a[FARTHEST], b[FARTHEST]), max(c[FARTHEST], d[FARTHEST])) < math.inf:
            return NOTHING
        return SILHOUETTE + edge
    return SURFACE + edge
