"""Wavefront OBJ: the `v` and `f` lines; materials, textures, normals, lines and curves are not looked at."""

from __future__ import annotations

import numpy as np
from numba import njit

from ocnf_data.arrays import F64, I64, U8
from ocnf_data.meshes.formats.polygons import (
    check_face_count,
    check_indices,
    fan,
    is_blank,
    parse_numbers,
    plain_text,
    unreadable,
)

_NEWLINE, _SLASH, _F, _V = ord("\n"), ord("/"), ord("f"), ord("v")


def parse_obj(data: bytes, where: str, max_faces: int) -> tuple[F64, I64]:
    """Vertices (N, 3) and triangles (M, 3) of an OBJ file.

    Corners may be `v`, `v/vt`, `v//vn` or `v/vt/vn`, counted from 1, or backwards from the last vertex
    defined above the face when negative. Polygons are fanned. The file's vertex order is kept.

    Raises:
        OcnfError: the file is not a whole OBJ file (`unreadable`), or has more than `max_faces` triangles
            (`too_large`).
    """
    text = plain_text(data)
    if b"\\\n" in text:  # a line continued on the next
        text = text.replace(b"\\\n", b" ") + b"\n"  # the last line may have been continued, too
    vertex_text, face_text, defined_above = _sort_lines(np.frombuffer(text, np.uint8))

    coordinates, counts = parse_numbers(vertex_text, where, np.float64)
    if (counts < 3).any():
        raise unreadable("a vertex has fewer than three coordinates", where)
    vertices = coordinates[(np.cumsum(counts) - counts)[:, None] + np.arange(3)]

    corners, n_corners = parse_numbers(face_text, where, np.int64)
    check_face_count(int(np.maximum(n_corners - 2, 0).sum()), max_faces, where)
    if (corners == 0).any():
        raise unreadable("a face has the index 0", where, expected="1 and up, or -1 and down")
    corners = np.where(corners < 0, corners + np.repeat(defined_above, n_corners), corners - 1)
    faces = fan(corners, np.cumsum(n_corners) - n_corners, n_corners)
    return vertices, check_indices(faces, len(vertices), where)


@njit(cache=True, nogil=True)
def _sort_lines(text: U8) -> tuple[U8, U8, I64]:
    """Take the vertex and the face lines out of a text of which every line ends in a newline.

    Returns:
        the vertex lines without their `v`; the face lines without their `f` and cut at the first slash of
        each corner (`7/2/9` becomes `7`; one that begins with a slash is kept, to be refused as no number);
        and for each face line how many vertex lines stand above it.
    """
    n_faces = 0
    for i in range(text.size):
        n_faces += text[i] == _F and (i + 1 == text.size or is_blank(text[i + 1]))
    vertex_text, face_text = np.empty(text.size, np.uint8), np.empty(text.size, np.uint8)
    defined_above = np.empty(n_faces, np.int64)
    v_end = f_end = n_vertices = n_faces = 0
    i = 0
    while i < text.size:
        while text[i] != _NEWLINE and is_blank(text[i]):
            i += 1
        kind = text[i] if i + 1 < text.size and is_blank(text[i + 1]) else 0
        if kind == _V:
            n_vertices += 1
            i += 1
            while text[i] != _NEWLINE:
                vertex_text[v_end] = text[i]
                v_end += 1
                i += 1
            vertex_text[v_end] = _NEWLINE
            v_end += 1
        elif kind == _F:
            defined_above[n_faces] = n_vertices
            n_faces += 1
            i += 1
            in_tail = False
            while text[i] != _NEWLINE:
                cut = text[i] == _SLASH and not is_blank(text[i - 1])
                in_tail = not is_blank(text[i]) and (in_tail or cut)
                if not in_tail:
                    face_text[f_end] = text[i]
                    f_end += 1
                i += 1
            face_text[f_end] = _NEWLINE
            f_end += 1
        else:
            while text[i] != _NEWLINE:
                i += 1
        i += 1
    return vertex_text[:v_end], face_text[:f_end], defined_above[:n_faces]
