"""What a view can say about a cube of voxels, decided from its depth pyramid without touching a voxel.

Conservative: the pixels looked at contain every pixel that a voxel centre of the cube rounds to, so skipping
what is classified never changes a value. Cubes come in eights, the parts of one parent, so that the geometry
of a view is vector code.
"""

from __future__ import annotations

import math

from numba import njit

from ocnf_data.arrays import F32, F64, I64
from ocnf_data.fusion.bundles import Eight, Rule
from ocnf_data.fusion.pyramid import DEEPEST, FARTHEST, NEAREST

NOTHING = 0
"""No voxel of the cube gets a contribution: hidden, behind the camera, outside the image, not measured."""
FREE = 1
"""Every voxel of the cube is seen to be free."""
SILHOUETTE = 2
"""Each voxel is either seen to be free or gets no contribution; none is near a surface."""
SURFACE = 3
"""All other cubes: a surface may be near some voxel."""
EDGE = 4
"""Added to SILHOUETTE or SURFACE if a voxel may lie outside the image or behind the camera."""

U0, U1, V0, V1, FRONT, BACK = range(6)
"""Rows of a footprint: first and last pixel column and row, least and greatest z_c in metres."""

# Far above the rounding of float64 at any coordinate in use, far below what matters.
_PIXEL_SLACK = 1e-6
_METRE_SLACK = 1e-9


@njit(cache=True, nogil=True, error_model="numpy")
def footprints(camera: F64, size: tuple[int, int], cubes: Eight, out: F64) -> None:
    """Pixels and depths that eight cubes may touch.

    `camera` is a row of `projection.grid_cameras`, `size` the image's
    (H, W); `out` (6, 8) receives the rows U0 to BACK, pixels clipped
    to one beyond the image. They mean nothing for a cube whose FRONT is not positive.
    """
    height, width = float(size[0]), float(size[1])
    z, y, x, cube_width = cubes
    half = 0.5 * (cube_width - 1)
    ux, uy, uz, u1 = camera[0], camera[1], camera[2], camera[3]
    vx, vy, vz, v1 = camera[4], camera[5], camera[6], camera[7]
    zx, zy, zz, z1 = camera[8], camera[9], camera[10], camera[11]
    cu, cv = camera[12], camera[13]
    reach = half * (abs(zx) + abs(zy) + abs(zz))
    for k in range(8):
        kx = x + half + cube_width * (k & 1)
        ky = y + half + cube_width * (k >> 1 & 1)
        kz = z + half + cube_width * (k >> 2)
        depth = zx * kx + zy * ky + zz * kz + z1
        front = depth - reach
        # Offsets (a, b) of (f X, Z) within the cube shift the pixel by (a - b f X / Z) / (Z + b). That
        # numerator is linear in the offset, so its extreme over the cube is an L1 norm.
        inverse, scale = 1.0 / depth, half / front
        tu = (ux * kx + uy * ky + uz * kz + u1) * inverse
        tv = (vx * kx + vy * ky + vz * kz + v1) * inverse
        ru = scale * (abs(ux - tu * zx) + abs(uy - tu * zy) + abs(uz - tu * zz)) + _PIXEL_SLACK
        rv = scale * (abs(vx - tv * zx) + abs(vy - tv * zy) + abs(vz - tv * zz)) + _PIXEL_SLACK
        out[U0, k] = max(math.floor(tu + cu - ru), -1.0)
        out[U1, k] = min(math.floor(tu + cu + ru), width)
        out[V0, k] = max(math.floor(tv + cv - rv), -1.0)
        out[V1, k] = min(math.floor(tv + cv + rv), height)
        out[FRONT, k] = front
        out[BACK, k] = depth + reach


@njit(cache=True, nogil=True, error_model="numpy")
def classify(footprint: F64, k: int, windows: F32, levels: I64, size: tuple[int, int], rule: Rule) -> int:
    """Class of one view for cube `k` of a footprint (6, 8).

    Args:
        footprint: (6, 8) footprint of the cubes in that view, by `footprints`.
        k: number of the cube among the eight, 0 to 7.
        windows: (n_entries, 3) part of the DepthPyramid that belongs to that view.
        levels: the DepthPyramid's.
        size: image size (H, W).
        rule: the encoding's; its two bounds decide.
    """
    front, back = footprint[FRONT, k], footprint[BACK, k]
    if back < -_METRE_SLACK:
        return NOTHING
    if front < _METRE_SLACK:
        return SURFACE + EDGE
    height, width = size
    u0, u1 = int(footprint[U0, k]), int(footprint[U1, k])
    v0, v1 = int(footprint[V0, k]), int(footprint[V1, k])
    if u1 < 0 or v1 < 0 or u0 >= width or v0 >= height:
        return NOTHING
    edge = 0
    if u0 < 0 or v0 < 0 or u1 >= width or v1 >= height:
        edge = EDGE
        u0, v0, u1, v1 = max(u0, 0), max(v0, 0), min(u1, width - 1), min(v1, height - 1)
    level = 1
    while (u1 >> level) - (u0 >> level) > 3 or (v1 >> level) - (v0 >> level) > 3:
        level += 1
    first, row = levels[level, 0], levels[level, 1]
    j0, i0 = u0 >> level, v0 >> level
    j1, i1 = max((u1 >> level) - 1, j0), max((v1 >> level) - 1, i0)
    upper, lower = first + i0 * row, first + i1 * row
    a, b, c, d = upper + j0, upper + j1, lower + j0, lower + j1
    nearest = min(min(windows[a, NEAREST], windows[b, NEAREST]),
                  min(windows[c, NEAREST], windows[d, NEAREST]))
    if nearest - back >= rule.free_from + _METRE_SLACK:
        return FREE if edge == 0 else SILHOUETTE + EDGE
    deepest = max(max(windows[a, DEEPEST], windows[b, DEEPEST]),
                  max(windows[c, DEEPEST], windows[d, DEEPEST]))
    if deepest - front < rule.hidden_below - _METRE_SLACK:
        farthest = max(max(windows[a, FARTHEST], windows[b, FARTHEST]),
                       max(windows[c, FARTHEST], windows[d, FARTHEST]))
        return NOTHING if farthest < math.inf else SILHOUETTE + edge
    return SURFACE + edge
