"""PLY, ASCII and binary of either endianness: the elements `vertex` and `face`.

```
ply
format ascii|binary_little_endian|binary_big_endian 1.0
element vertex 8
property float x                          a scalar
property list uchar int vertex_indices    a count, then that many numbers
end_header
```
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from ocnf_data.arrays import F64, I64, U8
from ocnf_data.meshes.formats.polygons import (
    check_face_count,
    check_indices,
    fan,
    parse_numbers,
    plain_text,
    unreadable,
)

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ENDIAN = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER = re.compile(rb"ply[ \t]*\r?\n(.*?\n)[ \t]*end_header[ \t]*\r?\n", re.DOTALL)
_MAX_HEADER = 2**20
_INDEX_NAMES = ("vertex_indices", "vertex_index")


@dataclass
class _Property:
    name: str
    dtype: np.dtype
    count_dtype: np.dtype | None = None  # of a list


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def place(self, names: tuple[str, ...], where: str, as_list: bool) -> int:
        """Index of the property called one of `names`; only scalars may stand before it."""
        for i, p in enumerate(self.properties):
            if p.name in names and (p.count_dtype is not None) == as_list:
                return i
            if p.count_dtype is not None:
                break
        raise unreadable(f"element {self.name} has no {names[0]}, or a list before it", where)

    def least_bytes(self, binary: bool) -> int:
        """The fewest bytes one row can take (in ASCII: a digit and a separator for each property)."""
        if not binary:
            return max(2 * len(self.properties), 1)
        kinds = (p.dtype if p.count_dtype is None else p.count_dtype for p in self.properties)
        return max(sum(kind.itemsize for kind in kinds), 1)


def parse_ply(data: bytes, where: str, max_faces: int) -> tuple[F64, I64]:
    """Vertices (N, 3) and triangles (M, 3) of a PLY file; polygons are fanned.

    Raises:
        OcnfError: the file is not a whole PLY file (`unreadable`), or has more than `max_faces` faces or
            triangles (`too_large`).
    """
    header = _HEADER.match(data, 0, _MAX_HEADER)
    if header is None:
        raise unreadable("not a PLY file, or its header has no end", where)
    form, elements = _parse_header(header[1], where)
    body = data[header.end():]
    claimed = 0
    for e in elements:
        claimed += e.count * e.least_bytes(binary=form != "ascii")
        if claimed > len(body) + 1:
            raise unreadable("the header claims more than the file holds", where,
                             found=f"{claimed} bytes or more in {len(body)}")
        if e.name == "face":
            check_face_count(e.count, max_faces, where)
    names = [e.name for e in elements]
    if len(set(names)) < len(names) or "vertex" not in names:
        raise unreadable("not one vertex element", where,
                         found=f"{names.count('vertex')} of them among {len(names)} elements")
    reader = _parse_ascii if form == "ascii" else _parse_binary
    vertices, corners, first, n_corners = reader(body, elements, where)
    check_face_count(int(np.maximum(n_corners - 2, 0).sum()), max_faces, where)
    return vertices, check_indices(fan(corners, first, n_corners), len(vertices), where)


def _parse_header(text: bytes, where: str) -> tuple[str, list[_Element]]:
    form, elements = "", list[_Element]()
    for number, raw in enumerate(text.decode("latin-1").split("\n"), start=2):
        match raw.split():
            case ["format", name, _] if name in _ENDIAN:
                form = name
            case ["element", name, count] if re.fullmatch(r"\d{1,15}", count):
                elements.append(_Element(name, int(count)))
            case ["property", "list", count, kind, name] if (
                elements and form and kind in _TYPES and _TYPES.get(count, "f")[0] in "iu"
            ):
                types = (np.dtype(_ENDIAN[form] + _TYPES[t]) for t in (kind, count))
                elements[-1].properties.append(_Property(name, *types))
            case ["property", kind, name] if elements and kind in _TYPES and form:
                elements[-1].properties.append(_Property(name, np.dtype(_ENDIAN[form] + _TYPES[kind])))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise unreadable("a header line makes no sense", where, found=f"line {number}")
    if not form:
        raise unreadable("the header names no format", where, expected=", ".join(_ENDIAN))
    return form, elements


def _parse_ascii(body: bytes, elements: list[_Element], where: str) -> tuple[F64, F64, I64, I64]:
    """Vertices, the numbers of the file, and where in them each polygon's corners begin and their count."""
    values, counts = parse_numbers(np.frombuffer(plain_text(body), np.uint8), where, np.float64)
    counts = counts[counts > 0]
    n_rows = sum(e.count for e in elements)
    if counts.size != n_rows:
        raise unreadable("the file ends early" if counts.size < n_rows else "the file holds more than its "
                         "header says", where, found=f"{counts.size} lines", expected=n_rows)
    starts = np.cumsum(counts) - counts
    vertices = np.empty((0, 3))
    first = n_corners = np.empty(0, np.int64)
    row = 0
    for e in elements:
        rows = slice(row, row + e.count)
        row += e.count
        if e.name == "vertex":
            places = [e.place((axis,), where, as_list=False) for axis in "xyz"]
            if (counts[rows] <= max(places)).any():
                raise unreadable("a vertex is cut short", where)
            vertices = values[starts[rows, None] + np.array(places)]
        elif e.name == "face":
            place = e.place(_INDEX_NAMES, where, as_list=True)
            if (counts[rows] <= place).any():
                raise unreadable("a face is cut short", where)
            announced = values[starts[rows] + place]
            if not ((announced >= 0) & (announced < counts[rows] - place)).all():
                raise unreadable("a face lists fewer corners than it announces", where)
            first, n_corners = starts[rows] + place + 1, announced.astype(np.int64)
    return vertices, values, first, n_corners


def _parse_binary(body: bytes, elements: list[_Element], where: str) -> tuple[F64, I64, I64, I64]:
    """What `_parse_ascii` returns; the corners are packed, one polygon after the other."""
    buffer = np.frombuffer(body, np.uint8)
    vertices = np.empty((0, 3))
    corners = first = n_corners = np.empty(0, np.int64)
    at = 0
    for e in elements:
        sizes = np.array([p.dtype.itemsize for p in e.properties], np.int64)
        counts = [p.count_dtype for p in e.properties]
        count_sizes = np.array([0 if c is None else c.itemsize for c in counts], np.int64)
        big = any(c is not None and c.str[0] == ">" for c in counts)
        wanted = e.place(_INDEX_NAMES, where, as_list=True) if e.name == "face" else -1
        if not count_sizes.any():
            offset, at = at, at + e.count * int(sizes.sum())
        else:
            at, begin, lengths = _walk(buffer, at, e.count, sizes, count_sizes, big, wanted)
        if not 0 <= at <= buffer.size:
            raise unreadable("the file ends early", where, found=f"{buffer.size} bytes of data")
        if e.name == "vertex":
            if count_sizes.any():
                raise unreadable("the vertex element has a list", where)
            record = np.dtype([(f"{i}", p.dtype) for i, p in enumerate(e.properties)])
            rows = np.frombuffer(body, record, count=e.count, offset=offset)
            vertices = np.stack([rows[str(e.place((axis,), where, as_list=False))] for axis in "xyz"], axis=1)
        elif e.name == "face":
            dtype = e.properties[wanted].dtype
            n_corners, first = lengths, np.cumsum(lengths) - lengths
            k = np.arange(n_corners.sum()) - np.repeat(first, n_corners)
            position = np.repeat(begin, n_corners) + k * dtype.itemsize
            corners = buffer[position[:, None] + np.arange(dtype.itemsize)].view(dtype)[:, 0]
    if body[at:].strip(b"\0\r\n\t "):
        raise unreadable("the file holds more than its header says", where,
                         found=f"{buffer.size} bytes of data", expected=at)
    return vertices.astype(np.float64), corners, first, n_corners


@njit(cache=True, nogil=True)
def _walk(buffer: U8, at: int, n_rows: int, sizes: I64, count_sizes: I64, big: bool,
          wanted: int) -> tuple[int, I64, I64]:
    """Step through rows that hold lists.

    Args:
        buffer: (n,) the data of the file.
        at: byte at which the element begins.
        n_rows: number of rows in the element.
        sizes: (P,) bytes a number of each property.
        count_sizes: (P,) bytes of the count of a list, 0 for a scalar.
        big: counts are big-endian.
        wanted: the list property to look up.

    Returns:
        the end (-1: past the end of the file), and for each row where the wanted list's numbers begin, and
        their count.
    """
    begin = np.zeros(n_rows, np.int64)
    counts = np.zeros(n_rows, np.int64)
    for row in range(n_rows):
        for p in range(sizes.size):
            n = np.int64(1)
            if count_sizes[p] > 0:
                if at + count_sizes[p] > buffer.size:
                    return -1, begin, counts
                n = np.int64(0)
                for b in range(count_sizes[p]):
                    byte = np.int64(buffer[at + b])
                    n = (n << 8) | byte if big else n | (byte << (8 * b))
                at += count_sizes[p]
                if p == wanted:
                    begin[row], counts[row] = at, n
            at += n * sizes[p]
            if at > buffer.size:  # a negative count reads as a huge one and ends here too
                return -1, begin, counts
    return at, begin, counts
