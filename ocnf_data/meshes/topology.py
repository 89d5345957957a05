"""How a triangle mesh hangs together. Recorded beside each sample, never required of it."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numba import njit

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError


class MeshStats(TypedDict):
    """Facts of a mesh; see `mesh_stats`."""

    n_vertices: int
    n_faces: int
    watertight: bool
    components: int
    degenerate_faces: int


def mesh_stats(vertices: F64, faces: I64) -> MeshStats:
    """Facts of a mesh with vertices (N, 3) and faces (M, 3).

    `n_vertices` and `n_faces` count what is there, `degenerate_faces` the faces without area. `watertight`
    (every undirected edge belongs to exactly two faces) and `components` (of faces joined at vertices) are
    those of the mesh with vertices of equal position welded, because STL and GLB store a vertex for every
    corner; faces that lose a corner by that are left out.
    """
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    welded = weld(vertices)[faces]
    whole = (welded != np.roll(welded, 1, axis=1)).all(axis=1)
    welded = welded[whole]
    return MeshStats(n_vertices=len(vertices), n_faces=len(faces), watertight=is_watertight(welded),
                     components=_components(welded, len(vertices)),
                     degenerate_faces=int((~(normal != 0).any(axis=1) | ~whole).sum()))


def is_watertight(faces: I64) -> bool:
    """Whether every undirected edge of faces (M, 3) belongs to exactly two of them (False for none)."""
    if len(faces) == 0:
        return False
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    edges = np.sort(np.minimum(a, b) * (int(faces.max()) + 1) + np.maximum(a, b))
    if edges.size % 2 or (edges[0::2] != edges[1::2]).any():
        return False
    return not (edges[2::2] == edges[1:-1:2]).any()


def weld(vertices: F64) -> I64:
    """Number of each vertex's position among the distinct ones, (N,)."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    new = np.ones(len(vertices), dtype=np.int64)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(vertices), np.int64)
    number[order] = np.cumsum(new) - 1
    return number


@njit(cache=True, nogil=True)
def _components(faces: I64, n_vertices: int) -> int:
    """Number of groups of faces joined at vertices: union-find with path halving."""
    parent = np.arange(n_vertices)
    used = np.zeros(n_vertices, np.bool_)
    for f in range(faces.shape[0]):
        for c in range(3):
            used[faces[f, c]] = True
        for c in range(1, 3):
            a, b = faces[f, 0], faces[f, c]
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            parent[a] = b
    count = 0
    for v in range(n_vertices):
        count += used[v] and parent[v] == v
    return count


def bounding_box(vertices: F64, faces: I64, where: str) -> tuple[F64, F64]:
    """Lowest and highest corner of the vertices that faces refer to.

    Raises:
        OcnfError: `degenerate` where the longest edge is zero, or too small or large to scale in float64.
    """
    used = vertices[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    with np.errstate(over="ignore"):
        longest = float((high - low).max())
    if not 1e-150 < longest < 1e150:
        raise OcnfError("the mesh has no usable extent", code="degenerate", where=where, found=longest,
                        expected="a bounding box with a longest edge")
    return low, high
