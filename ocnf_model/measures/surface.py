"""Surfaces as what is measured of them: samples, and the distance from a point to the nearest triangle."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from numba import njit, prange
from scipy.spatial import cKDTree

from ocnf_data.arrays import F32, F64, I64
from ocnf_data.octree import GridOctree
from ocnf_data.octree.triangles import cell_triangles

N_SAMPLES = 30_000
"""Samples of a surface: a share of them is known to 0.3 %."""
_SEED = 0
_NEAREST = 3  # parts whose triangles are looked at


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of a surface.

    Attributes:
        points: (N, 3) float64, x y z, in metres.
        normals: (N, 3) float64, of length 1.
        triangles: (N,) int64: which triangle each lies on.
    """

    points: F64
    normals: F64
    triangles: I64

    def __len__(self) -> int:
        return len(self.points)

    def chosen(self, which: npt.NDArray[Any]) -> Samples:
        """Some of them, by a mask or by index."""
        return Samples(self.points[which], self.normals[which], self.triangles[which])


def sample_triangles(triangles: npt.NDArray[np.floating], n: int = N_SAMPLES, seed: int = _SEED) -> Samples:
    """Points spread evenly over the area of triangles: one in each n-th of it, uniform within that.

    Args:
        triangles: (M, 3, 3), in metres.
        n: number of points; none where the area is 0.
        seed: the same one gives the same points.
    """
    doubled = _doubled_areas(triangles)
    total = np.cumsum(doubled)
    if not len(total) or not total[-1] > 0:
        return Samples(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.int64))
    u, v, w = np.random.default_rng(seed).random((3, n))
    chosen = np.searchsorted(total, (np.arange(n) + u) / n * total[-1], side="right")
    chosen = np.minimum(chosen, np.flatnonzero(doubled)[-1])  # rounding may lead beyond the last one
    root = np.sqrt(v)[:, None]
    shares = np.concatenate([1 - root, root * (1 - w[:, None]), root * w[:, None]], axis=1)
    corners = triangles[chosen].astype(np.float64)
    return Samples(np.einsum("nk,nkc->nc", shares, corners), _normals(corners), chosen)


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in small parts, each with a point by which it is found.

    The nearest triangle is looked for in the parts of the three nearest centres. So a distance is never too
    small, and where parts are smaller than the distance that matters, as the cells of a grid are, it is too
    large by a vanishing share.

    Attributes:
        triangles: (M, 3, 3) float32, metres.
        first: (P + 1,) int64: part p has the triangles first[p] to first[p + 1] - 1.
        centres: (P, 3) float32, a point on or near each part.
    """

    triangles: F32
    first: I64
    centres: F32

    @classmethod
    def of_octree(cls, octree: GridOctree, extent: float) -> Self:
        """The surface of a TSDF octree (1 channel, negative inside), a part for each cell; metres."""
        return cls(*cell_triangles(octree, extent))

    @classmethod
    def around(cls, samples: Samples, triangles: F64) -> Self:
        """The surface of a mesh of triangles (M, 3, 3), as far as it has samples: a part a sample."""
        return cls(triangles[samples.triangles].astype(np.float32), np.arange(len(samples) + 1),
                   samples.points.astype(np.float32))

    @cached_property
    def samples(self) -> Samples:
        """`N_SAMPLES` points spread evenly over the area."""
        return sample_triangles(self.triangles)

    @cached_property
    def _tree(self) -> Any:
        return cKDTree(self.centres, balanced_tree=False, compact_nodes=False)

    def nearest(self, points: F64) -> tuple[F64, F64]:
        """The distances (N,) from points (N, 3) to the surface in metres, and its normals (N, 3) there.

        Infinite and 0 where there is no surface. The normal of a triangle without area is 0.
        """
        if not len(self.centres):
            return np.full(len(points), np.inf), np.zeros((len(points), 3))
        near = min(_NEAREST, len(self.centres))
        _, parts = self._tree.query(points, k=np.arange(1, near + 1), workers=-1)
        distances, found = _nearest(points, parts, self.first, self.triangles)
        return distances, _normals(self.triangles[found].astype(np.float64))


def _normals(triangles: F64) -> F64:
    """Unit normals (N, 3) of triangles (N, 3, 3), anticlockwise as seen from the front; 0 without an area."""
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(crosses, axis=1, keepdims=True)
    normals: F64 = crosses / np.where(lengths > 0, lengths, 1)
    return normals


@njit(cache=True, nogil=True, parallel=True)
def _nearest(points: F64, parts: I64, first: I64, triangles: F32) -> tuple[F64, I64]:
    """The nearest of the triangles of some parts (N, k) to each point (N, 3): its distance, and which."""
    distances, found = np.empty(len(points)), np.empty(len(points), np.int64)
    for n in prange(len(points)):
        best, which = np.inf, -1
        for k in range(parts.shape[1]):
            for t in range(first[parts[n, k]], first[parts[n, k] + 1]):
                squared = _squared_distance(points[n], triangles[t])
                if squared < best:
                    best, which = squared, t
        distances[n], found[n] = np.sqrt(best), which
    return distances, found


@njit(cache=True, nogil=True)
def _squared_distance(point: F64, triangle: F32) -> float:
    """Squared distance from a point (3,) to a triangle (3, 3), even one without area; scalars for speed."""
    a, b, c = (_minus(triangle[0], point), _minus(triangle[1], point), _minus(triangle[2], point))
    ab, bc, ca = _minus(b, a), _minus(c, b), _minus(a, c)
    normal = _cross(ca, ab)
    area = _dot(normal, normal)
    # Above the triangle, if on the inner side of all three edges; else the nearest edge is the nearest part.
    if area > 0 and _dot(_cross(a, ab), normal) >= 0 and _dot(_cross(b, bc), normal) >= 0 \
            and _dot(_cross(c, ca), normal) >= 0:
        return _dot(normal, a) ** 2 / area
    return min(_to_edge(a, ab), _to_edge(b, bc), _to_edge(c, ca))


@njit(cache=True, nogil=True)
def _to_edge(start, edge):  # type: ignore[no-untyped-def]
    """Squared distance of the origin from a segment."""
    length = _dot(edge, edge)
    share = min(max(-_dot(start, edge) / length, 0.0), 1.0) if length > 0 else 0.0
    x, y, z = start[0] + share * edge[0], start[1] + share * edge[1], start[2] + share * edge[2]
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def _minus(a, b):  # type: ignore[no-untyped-def]
    return np.float64(a[0]) - b[0], np.float64(a[1]) - b[1], np.float64(a[2]) - b[2]


@njit(cache=True, nogil=True)
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, parallel=True)
def _doubled_areas(triangles):  # type: ignore[no-untyped-def]
    """(M,) float64 of triangles (M, 3, 3)."""
    areas = np.empty(len(triangles))
    for t in prange(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        normal = _cross(_minus(b, a), _minus(c, a))
        areas[t] = np.sqrt(_dot(normal, normal))
    return areas
