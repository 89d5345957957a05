"""OFF, with what real files do to it: `OFF3514 3546 0`, comments, blank lines, polygons, colours."""

from __future__ import annotations

import re

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.meshes.formats.polygons import (
    check_face_count,
    check_indices,
    fan,
    parse_numbers,
    plain_text,
    unreadable,
)

# The counts may follow the word at once; the number of edges is often missing and never needed.
# ST, C and N announce texture coordinates, colours and normals behind the three coordinates of a vertex.
_HEADER = re.compile(rb"\s*(?:ST)?C?N?OFF\s*(\d{1,12})\s+(\d{1,12})(?:[ \t]+-?\d+)?[ \t]*\n")


def parse_off(data: bytes, where: str, max_faces: int) -> tuple[F64, I64]:
    """Vertices (N, 3) and triangles (M, 3) of an ASCII OFF file; polygons are fanned, colours ignored.

    Raises:
        OcnfError: the file is not a whole OFF file (`unreadable`), or has more than `max_faces` faces or
            triangles (`too_large`).
    """
    text = plain_text(data)
    header = _HEADER.match(text)
    if header is None:
        raise unreadable("not an ASCII OFF file", where,
                         expected="OFF, then the numbers of vertices and faces")
    n_vertices, n_faces = int(header[1]), int(header[2])
    check_face_count(n_faces, max_faces, where)
    body = np.frombuffer(text, np.uint8)[header.end():]
    if 2 * (n_vertices + n_faces) > body.size:
        raise unreadable("the header claims more than the file holds", where,
                         found=f"{n_vertices} vertices and {n_faces} faces in {body.size} bytes")

    values, counts = parse_numbers(body, where, np.float64)
    counts = counts[counts > 0]
    if counts.size < n_vertices + n_faces:
        raise unreadable("the file ends early", where, found=f"{counts.size} lines",
                         expected=f"{n_vertices} vertices and {n_faces} faces")
    if counts.size > n_vertices + n_faces:
        raise unreadable("the file goes on behind the faces that the header announces", where,
                         found=f"{counts.size} lines", expected=f"{n_vertices} vertices and {n_faces} faces")
    first = np.cumsum(counts) - counts
    vertex, face = slice(0, n_vertices), slice(n_vertices, n_vertices + n_faces)
    if (counts[vertex] < 3).any():
        raise unreadable("a vertex has fewer than three coordinates", where)
    vertices = values[first[vertex, None] + np.arange(3)]
    n_corners = values[first[face]]
    if not ((n_corners >= 0) & (n_corners < counts[face])).all():
        raise unreadable("a face lists fewer corners than it announces", where)
    if (n_corners != np.floor(n_corners)).any():
        raise unreadable("a face's number of corners is no whole number", where)
    n_corners = n_corners.astype(np.int64)
    check_face_count(int(np.maximum(n_corners - 2, 0).sum()), max_faces, where)
    return vertices, check_indices(fan(values, first[face] + 1, n_corners), n_vertices, where)
