"""Wavefront OBJ: the `v` and `f` lines; materials, textures, normals, lines and curves are not looked at."""

from __future__ import annotations

import numpy as np

from ocnf_data.sources.formats.polygons import (
    F64,
    I64,
    U8,
    check_face_count,
    check_indices,
    fan,
    parse_numbers,
    plain_text,
    token_starts,
    tokens_per_line,
    unreadable,
)

_SPACE, _SLASH = ord(" "), ord("/")


def parse_obj(data: bytes, where: str, max_faces: int) -> tuple[F64, I64]:
    """Vertices (N, 3) and triangles (M, 3) of an OBJ file.

    Corners may be `v`, `v/vt`, `v//vn` or `v/vt/vn`, counted from 1, or backwards from the last vertex
    defined above the face when negative. Polygons are fanned. The file's vertex order is kept.
    """
    plain = plain_text(data)
    if b"\\\n" in plain:  # a line continued on the next
        plain = plain.replace(b"\\\n", b" ")
    text = np.frombuffer(plain, np.uint8).copy()
    starts = token_starts(text)
    per_line, newlines = tokens_per_line(text, starts)
    lengths = np.diff(newlines, prepend=-1)
    # A blank line has no first token; its newline stands in.
    head = newlines.copy()
    head[per_line > 0] = starts[(np.cumsum(per_line) - per_line)[per_line > 0]]
    alone = (per_line > 0) & (text[head + (per_line > 0)] <= _SPACE)
    is_vertex, is_face = (alone & (text[head] == ord(letter)) for letter in "vf")
    text[head[is_vertex | is_face]] = _SPACE

    coordinates, counts = parse_numbers(text[np.repeat(is_vertex, lengths)], where, np.float64)
    if (counts < 3).any():
        raise unreadable("a vertex has fewer than three coordinates", where)
    vertices = coordinates[(np.cumsum(counts) - counts)[:, None] + np.arange(3)]

    face_text = _first_of_each(text[np.repeat(is_face, lengths)], where)
    corners, n_corners = parse_numbers(face_text, where, np.int64)
    check_face_count(int(np.maximum(n_corners - 2, 0).sum()), max_faces, where)
    defined_above = np.repeat(np.cumsum(is_vertex)[is_face], n_corners)
    if (corners == 0).any():
        raise unreadable("a face has the index 0", where, expected="1 and up, or -1 and down")
    corners = np.where(corners < 0, corners + defined_above, corners - 1)
    faces = fan(corners, np.cumsum(n_corners) - n_corners, n_corners)
    return vertices, check_indices(faces, len(vertices), where)


def _first_of_each(text: U8, where: str) -> U8:
    """Blank everything from the first slash of each token on: `7/2/9` becomes `7`."""
    slash = text == _SLASH
    if not slash.any():
        return text
    starts = token_starts(text)
    if slash[starts].any():
        raise unreadable("a face has a corner without a vertex", where)
    position = np.arange(text.size, dtype=np.int64)
    token = np.zeros_like(position)
    token[starts] = starts
    last_slash = np.maximum.accumulate(np.where(slash, position, -1))
    in_tail = (last_slash >= np.maximum.accumulate(token)) & (text > _SPACE)
    return np.where(in_tail, np.uint8(_SPACE), text)
