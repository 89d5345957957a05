"""STL, binary and ASCII. Its triangles share no vertices: corner c of triangle f is vertex 3 f + c."""

from __future__ import annotations

import re
from collections import Counter

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.meshes.formats.polygons import (
    check_face_count,
    parse_numbers,
    plain_text,
    unreadable,
)

_HEADER_BYTES = 84  # 80 of free text, then the number of triangles
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_WORDS = re.compile(rb"^[ \t]*(solid|end ?solid|facet|end ?facet)\b", re.IGNORECASE | re.MULTILINE)
_VERTEX = re.compile(rb"\bvertex\b([^\n]*\n)", re.IGNORECASE)


def parse_stl(data: bytes, where: str, max_faces: int) -> tuple[F64, I64]:
    """Vertices (3 M, 3) and triangles (M, 3); binary if it holds as many as it claims, else ASCII.

    Raises:
        OcnfError: the file is not a whole STL file (`unreadable`), or has more than `max_faces` triangles
            (`too_large`).
    """
    n = int.from_bytes(data[80:_HEADER_BYTES], "little")
    size = _HEADER_BYTES + n * _RECORD.itemsize
    # Some programs write something more behind the triangles. Text is never taken for binary: its characters
    # at that place would claim gigabytes.
    if len(data) == size or (n > 0 and len(data) > size):
        check_face_count(n, max_faces, where)
        corners = np.frombuffer(data, _RECORD, n, _HEADER_BYTES)["corners"]
        vertices = corners.reshape(-1, 3).astype(np.float64)
    elif data[:512].lstrip()[:5].lower() == b"solid" and (_VERTEX.search(data) or b"endsolid" in data):
        check_face_count(data.count(b"vertex") // 3, max_faces, where)
        text = plain_text(data)
        lines = np.frombuffer(b"".join(_VERTEX.findall(text)), np.uint8)
        values, counts = parse_numbers(lines, where, np.float64)
        if (counts != 3).any() or counts.size % 3:
            raise unreadable("a triangle has not three corners of three coordinates", where)
        words = Counter(word.lower().replace(b" ", b"") for word in _WORDS.findall(text))
        n_facets, n_solids = counts.size // 3, words[b"solid"]
        if not (words[b"facet"] == words[b"endfacet"] == n_facets and words[b"endsolid"] == n_solids):
            raise unreadable("the file ends early, or a triangle has no end", where,
                             found=f"facet {words[b'facet']}, endfacet {words[b'endfacet']}, solid "
                                   f"{n_solids}, endsolid {words[b'endsolid']} times",
                             expected=f"{n_facets} of the first two, and as many of the others")
        vertices = values.reshape(-1, 3)
    else:
        raise unreadable("not an STL file: it does not hold the number of triangles it claims", where,
                         found=f"{len(data)} bytes, {n} triangles")
    return vertices, np.arange(len(vertices), dtype=np.int64).reshape(-1, 3)
