"""Surfaces and points small enough to send: fewer triangles, positions of 16 bits, errors of 8."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ocnf_data.arrays import F64, I64, U8
from ocnf_data.meshes.decimate import collapse_edges
from ocnf_data.views.cameras import Views

STEPS = 65535
"""Positions go from 0 to this over the cube: at 3 m a step is 0.05 mm."""


class Triangles(NamedTuple):
    """Vertices (N, 3) in metres and faces (M, 3)."""

    vertices: F64
    faces: I64


def simplify(surface: Triangles, most: int) -> Triangles:
    """At most about `most` triangles, by quadric edge collapse (Garland and Heckbert, SIGGRAPH 1997).

    Raises:
        OcnfError: `missing_extra` without fast-simplification.
    """
    if len(surface.faces) <= most:
        return surface
    return Triangles(*collapse_edges(*surface, most, "the page", "generate"))


def as_steps(points: F64, extent: float) -> np.ndarray:
    """Positions (N, 3) uint16: 0 is -extent / 2, `STEPS` is extent / 2; what lies outside is moved there."""
    return np.clip(np.rint((points / extent + 0.5) * STEPS), 0, STEPS).astype(np.uint16)


def ordered(surface: Triangles) -> Triangles:
    """The same triangles, in an order in which `blob` packs them small.

    Vertices come in the order of their place (z, y, x) and faces in that of their first vertex: neighbours in
    the list are neighbours in space, so that differences are small.
    """
    vertices, faces = surface
    used = np.unique(faces) if len(faces) else np.empty(0, np.int64)
    kept = vertices[used]
    cell = np.floor((kept - kept.min(axis=0)) / max(np.ptp(kept), 1e-12) * 48).astype(np.int64) if len(
        kept) else np.empty((0, 3), np.int64)
    order = np.lexsort((kept[:, 2], cell[:, 0], cell[:, 1], cell[:, 2]))
    place = np.empty(len(vertices), np.int64)
    place[used[order]] = np.arange(len(used))
    moved = place[faces]
    # The lowest corner first: turning a triangle changes nothing.
    first = moved.argmin(axis=1) if len(moved) else np.empty(0, np.int64)
    moved = np.take_along_axis(moved, (first[:, None] + np.arange(3)) % 3, axis=1)
    return Triangles(kept[order], moved[np.lexsort(moved.T[::-1])])


def drawn_on(surface: Triangles, n: int, seed: int = 0) -> F64:
    """Points (n, 3) drawn evenly on a surface of one triangle or more, the same ones every time."""
    corners = surface.vertices[surface.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    random = np.random.default_rng(seed)
    chosen = corners[np.searchsorted(np.cumsum(area), random.random(n) * area.sum()).clip(0, len(area) - 1)]
    u, v = np.sqrt(random.random(n))[:, None], random.random(n)[:, None]
    return chosen[:, 0] * (1 - u) + chosen[:, 1] * (u * (1 - v)) + chosen[:, 2] * (u * v)


def seen_points(views: Views, most: int, seed: int = 0) -> F64:
    """World points (N, 3), at most `most`, of the pixels that have a measurement, drawn from all views."""
    view, row, column = np.nonzero(np.isfinite(views.depth) & (views.depth > 0))
    if len(view) > most:
        chosen = np.sort(np.random.default_rng(seed).choice(len(view), most, replace=False))
        view, row, column = view[chosen], row[chosen], column[chosen]
    z = views.depth[view, row, column].astype(np.float64)
    K = views.K[view]
    ray = np.stack([(column - K[:, 0, 2]) / K[:, 0, 0], (row - K[:, 1, 2]) / K[:, 1, 1], np.ones_like(z)],
                   axis=1)
    return np.einsum("ni,nij->nj", ray * z[:, None] - views.T[view], views.R[view])


def as_bytes(error: F64, limit: float) -> U8:
    """Errors (N,) of 0 to `limit` metres as 0 to 255; what is larger is 255."""
    return np.clip(np.rint(error / limit * 255), 0, 255).astype(np.uint8)
