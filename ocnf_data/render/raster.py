"""Depth by z-buffer on the CPU, exact at pixel centres, two-sided, with numba.

Each triangle is walked row by row. On row v its edges give an interval of u, and every whole u in it, ends
included, is covered: a pixel centre exactly on an edge or a vertex counts. What makes shared edges watertight
is that an edge's crossing with a row depends on nothing but its two end points, taken in a fixed order (upper
first): both triangles compute the same number, one ends at it and the other begins there. No fill rule is
needed, since both may draw and the nearest wins.

Inverse depth w = 1 / z is linear in the image, so it is what is interpolated (float64) and compared
(float32); it is turned into depth once at the end. The buffer starts at w = 0, which is depth inf.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numba
import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, F64, I64, U32

# A triangle narrower than this many pixels at its middle vertex is seen edge on: the slope of w across it is
# rounding noise, so w is taken from its long edge.
_EDGE_ON = 1e-9

# Pixels are drawn by this many at a time; the buffer is longer than the image by as much.
_LANES = 8

Vertex: TypeAlias = tuple[float, float, float]
"""A projected vertex (u, v, w): pixels and 1 / z."""


class Cameras(NamedTuple):
    """V cameras.

    Attributes:
        pinholes: (V, 4) fx, fy, cx, cy in pixels.
        R: (V, 3, 3) world to camera.
        T: (V, 3) metres, world to camera.
        near: metres, the plane in front of which is drawn.
    """

    pinholes: F64
    R: F64
    T: F64
    near: float


class Buffer(NamedTuple):
    """Inverse depth of an image: (H * W + 8,) float32, its height and its width."""

    inverse: F32
    height: int
    width: int


def rasterise(
    vertices: F64, faces: I64, K: F64, R: F64, T: F64, size: tuple[int, int], near: float = 1e-3
) -> F32:
    """Depth (V, H, W) float32, z in metres, inf where no triangle is hit at z > near.

    Arguments are trusted to be valid and C-contiguous; `render_depth` checks them.

    Args:
        vertices: (N, 3) world coordinates in metres.
        faces: (M, 3) vertex indices, any winding; faces without area in the image draw nothing.
        K: (V, 3, 3) intrinsics in pixels.
        R: (V, 3, 3) world to camera.
        T: (V, 3) metres, world to camera.
        size: (H, W).
        near: metres; what lies at z <= near is cut off, triangles that cross that plane are clipped to it.
    """
    depth = np.empty((len(R), *size), dtype=np.float32)
    pinholes = np.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], axis=1)  # (V, 4)
    scene = (vertices, faces.astype(np.uint32), Cameras(pinholes, R, T, float(near)))
    n_threads = min(len(R), numba.get_num_threads())
    if n_threads == 1:
        # Starts no thread pool, so it is safe in forked children and in Python threads.
        _render_strided(*scene, 0, 1, depth)
    else:
        _render_parallel(*scene, n_threads, depth)
    return depth


@njit(cache=True, nogil=True, parallel=True)
def _render_parallel(vertices: F64, faces: U32, cameras: Cameras, n_threads: int, depth: F32) -> None:
    for thread in prange(n_threads):
        _render_strided(vertices, faces, cameras, thread, n_threads, depth)


@njit(cache=True, nogil=True, error_model="numpy")
def _render_strided(vertices: F64, faces: U32, cameras: Cameras, start: int, step: int, depth: F32) -> None:
    """Render views start, start + step, ...; each is one thread's alone, so thread counts change nothing."""
    pinholes, R, T, near = cameras
    height, width = depth.shape[1:]
    projected = np.empty((len(vertices), 3))
    buffer = np.zeros(height * width + _LANES, np.float32)  # 1 / z, kept in the cache from view to view
    image = Buffer(buffer, height, width)
    for view in range(start, len(depth), step):
        _project(vertices, pinholes[view], R[view], T[view], near, projected)
        for f in range(len(faces)):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            wa, wb, wc = projected[a, 2], projected[b, 2], projected[c, 2]
            if wa > 0.0 and wb > 0.0 and wc > 0.0:
                _draw(image, (projected[a, 0], projected[a, 1], wa), (projected[b, 0], projected[b, 1], wb),
                      (projected[c, 0], projected[c, 1], wc))
            elif wa > 0.0 or wb > 0.0 or wc > 0.0:
                _draw_clipped(image, vertices, faces[f], pinholes[view], R[view], T[view], near)
        pixels = depth[view].ravel()
        for i in range(len(pixels)):
            pixels[i] = np.float32(1.0) / buffer[i]
            buffer[i] = np.float32(0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _project(vertices: F64, pinhole: F64, R: F64, T: F64, near: float, out: F64) -> None:
    """Write (u, v, w) of every vertex: pixels and 1 / z, with w = 0 marking z <= near."""
    fx, fy, cx, cy = pinhole
    for i in range(len(vertices)):
        x, y, z = _to_camera(vertices[i], R, T)
        w = 1.0 / z
        out[i, 0] = fx * x * w + cx
        out[i, 1] = fy * y * w + cy
        out[i, 2] = w if z > near else 0.0


@njit(cache=True, nogil=True)
def _to_camera(p: F64, R: F64, T: F64) -> tuple[float, float, float]:
    return (
        R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2] + T[0],
        R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2] + T[1],
        R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + T[2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(image: Buffer, a: Vertex, b: Vertex, c: Vertex) -> None:
    """Draw one triangle into the buffer."""
    buffer, height, width = image
    (ua, va, wa), (ub, vb, wb), (uc, vc, wc) = a, b, c
    # Most triangles of a fine mesh hold no pixel centre and end here.
    top, bottom = np.ceil(min(va, vb, vc)), np.floor(max(va, vb, vc))
    left, right = np.ceil(min(ua, ub, uc)), np.floor(max(ua, ub, uc))
    if not (top <= bottom and left <= right and bottom >= 0 and right >= 0 and top < height and left < width):
        return
    a, b = _upper_first(a, b)
    b, c = _upper_first(b, c)
    a, b = _upper_first(a, b)
    (ua, va, wa), (ub, vb, wb), (uc, vc, wc) = a, b, c
    slope_ac = (uc - ua) / (vc - va)
    across = ub - (ua + (vb - va) * slope_ac)
    if va == vc or across == 0.0:
        return
    slope_ab = (ub - ua) / (vb - va)  # 1 / 0 where the two share a row: the slope is then used by no row
    slope_bc = (uc - ub) / (vc - vb)
    rate = (wc - wa) / (vc - va)
    gradient = (wb - (wa + (vb - va) * rate)) / across if abs(across) > _EDGE_ON else 0.0

    first_row = int(top) if top > 0.0 else 0
    last_row = int(bottom) if bottom < height - 1 else height - 1
    for row in range(first_row, last_row + 1):
        v = float(row)
        # At its lower end an edge is exactly that vertex, so that all triangles around it agree there.
        u_long = uc if v == vc else ua + (v - va) * slope_ac
        if v < vb:
            u_short = ua + (v - va) * slope_ab
        elif v == vb:
            u_short = ub
        else:
            u_short = uc if v == vc else ub + (v - vb) * slope_bc
        left, right = min(u_long, u_short), max(u_long, u_short)
        # Written so that even a NaN stays inside the image.
        left = np.ceil(left if left > 0.0 else 0.0)
        left = left if left < width else float(width)
        right = np.floor(right if right < width - 1 else width - 1.0)
        right = right if right > -1.0 else -1.0
        n = np.int32(right) - np.int32(left) + np.int32(1)
        w = wa + (v - va) * rate + (left - u_long) * gradient
        # Rows of CAD models are short, 2 pixels on average, and a loop of unpredictable length costs more
        # than its pixels: so whole vectors are drawn, at least one, and what lies past the end is masked.
        at = np.uint64(row * width + int(left))
        for k in range(np.uint32((max(n, np.int32(1)) + np.int32(_LANES - 1)) & np.int32(-_LANES))):
            i = np.int32(k)
            new, old = np.float32(w + i * gradient), buffer[at + k]
            buffer[at + k] = new if (new > old) & (i < n) else old


@njit(cache=True, nogil=True)
def _upper_first(a: Vertex, b: Vertex) -> tuple[Vertex, Vertex]:
    """The two vertices, the upper one first; the order of two in one row does not matter."""
    if b[1] < a[1]:
        return b, a
    return a, b


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_clipped(image: Buffer, vertices: F64, face: U32, pinhole: F64, R: F64, T: F64, near: float) -> None:
    """Draw the part in front of the near plane of a triangle that crosses it: one or two triangles."""
    fx, fy, cx, cy = pinhole
    corners = np.empty((3, 3))
    for k in range(3):
        corners[k, 0], corners[k, 1], corners[k, 2] = _to_camera(vertices[face[k]], R, T)
    polygon = np.empty((4, 3))  # of (x, y, z), then of (u, v, w)
    n = 0
    for k in range(3):
        p, q = corners[k], corners[(k + 1) % 3]
        if p[2] > near:
            polygon[n] = p
            n += 1
        if (p[2] > near) != (q[2] > near):
            # From the front end to the back end, so that both triangles of an edge get the same point.
            front, back = (p, q) if p[2] > near else (q, p)
            polygon[n] = front + (front[2] - near) / (front[2] - back[2]) * (back - front)
            polygon[n, 2] = near
            n += 1
    for k in range(n):
        x, y, z = polygon[k]
        w = 1.0 / z
        polygon[k] = fx * x * w + cx, fy * y * w + cy, w
    a = polygon[0]
    for k in range(1, n - 1):
        b, c = polygon[k], polygon[k + 1]
        _draw(image, (a[0], a[1], a[2]), (b[0], b[1], b[2]), (c[0], c[1], c[2]))
