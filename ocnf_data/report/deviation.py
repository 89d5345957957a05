"""How far points lie from a surface: the error that the page shows as colour."""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.report.geometry import Triangles

_NEAREST = 6  # triangles by their centre; the nearest one to a point is among them on meshes as even as these


class Deviation:
    """Distances to a surface of small, even triangles, as marching cubes makes them.

    Exact where the nearest triangle is among the six whose centres are nearest, which even triangles give.

    Args:
        surface: the reference; it may be empty, and then nothing is known.
    """

    def __init__(self, surface: Triangles) -> None:
        from scipy.spatial import cKDTree

        self._corners = surface.vertices[surface.faces]
        self._tree = cKDTree(self._corners.mean(axis=1)) if len(surface.faces) else None

    def __call__(self, points: F64) -> F64:
        """Distance (N,) of each point (N, 3) to the surface, metres; NaN where the surface is empty."""
        if self._tree is None or not len(points):
            return np.full(len(points), np.nan)
        k = min(_NEAREST, self._tree.n)
        near = self._tree.query(points, k)[1].reshape(len(points), k)
        best = np.full(len(points), np.inf)
        for column in near.T:
            np.minimum(best, _to_triangles(points, self._corners[column]), out=best)
        return best


def _to_triangles(points: F64, corners: F64) -> F64:
    """Distance (N,) of points (N, 3) to triangles (N, 3, 3): to the inside, or to the nearest edge."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    unit = np.divide(normal, area[:, None], out=np.zeros_like(normal), where=area[:, None] > 0)
    inside = area > 0
    edges = np.full(len(points), np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        along = end - start
        inside &= (np.cross(along, points - start) * normal).sum(axis=1) >= 0
        length = (along**2).sum(axis=1)
        share = np.divide(((points - start) * along).sum(axis=1), length, out=np.zeros_like(length),
                          where=length > 0)
        nearest = start + np.clip(share, 0, 1)[:, None] * along
        edges = np.minimum(edges, np.linalg.norm(points - nearest, axis=1))
    return np.where(inside, np.abs(((points - a) * unit).sum(axis=1)), edges)
