"""What is done to a mesh after it is cut out: vertices left out, loose parts dropped, faces decimated."""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F64, I64, Bool
from ocnf_data.errors import OcnfError
from ocnf_data.meshes.decimate import check_library, collapse_edges

_DECIMATING = "decimating"
LOOSE_VOXELS = 16.0
"""A part of the surface whose box has a shorter diagonal than so many voxels is loose."""


def keep_vertices(vertices: F64, faces: I64, kept: Bool) -> tuple[F64, I64]:
    """The faces whose corners are all kept, and the vertices that they use."""
    return _compact(vertices, faces[kept[faces].all(axis=1)])


def drop_loose(vertices: F64, faces: I64, diagonal: float) -> tuple[F64, I64, int]:
    """The mesh without its small parts, and how many those were; the largest part always stays.

    Parts are what hangs together by shared vertices.

    Args:
        vertices: (N, 3) metres.
        faces: (M, 3).
        diagonal: metres; a part stays whose bounding box has at least this diagonal.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(faces):
        return vertices, faces, 0
    n = len(vertices)
    ends = faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(ends), np.bool_), (np.repeat(faces[:, 0], 2), ends)), (n, n))
    count, part = connected_components(graph, directed=False)
    order = np.argsort(part, kind="stable")
    first = np.searchsorted(part[order], np.arange(count))
    low, high = (extreme.reduceat(vertices[order], first, axis=0) for extreme in (np.minimum, np.maximum))
    lengths = np.linalg.norm(high - low, axis=1)
    stays = (lengths >= diagonal) | (np.arange(count) == lengths.argmax())
    return *_compact(vertices, faces[stays[part[faces[:, 0]]]]), int((~stays).sum())


def decimate(vertices: F64, faces: I64, count: int) -> tuple[F64, I64]:
    """The mesh with about `count` faces (`collapse_edges`); the mesh itself where it has no more.

    Raises:
        OcnfError: `count` is not positive, or fast-simplification is not installed.
    """
    check_faces(count)
    if len(faces) <= count:
        return vertices, faces
    return _compact(*collapse_edges(vertices, faces, count, _DECIMATING, "fuse"))


def check_faces(count: int) -> None:
    """Raise OcnfError unless a mesh can be decimated to so many faces here."""
    if not isinstance(count, int | np.integer) or count < 4:
        raise OcnfError("not a number of faces", field="faces", found=count, expected="4 or more")
    check_library(_DECIMATING, "fuse")


def _compact(vertices: F64, faces: I64) -> tuple[F64, I64]:
    """The vertices that faces use, and the faces with their new numbers."""
    used = np.unique(faces)
    number = np.empty(len(vertices), np.int64)
    number[used] = np.arange(len(used))
    return vertices[used], number[faces]
