"""Triangle meshes as bytes: PLY, OBJ, OFF and STL."""

from __future__ import annotations

import io
from typing import Protocol

import numpy as np

from ocnf_data.arrays import F64, I64, U8

_STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_DIGITS = "%.12g"


def _ply(vertices: F64, faces: I64, colours: U8 | None = None) -> bytes:
    names = ("red", "green", "blue") if colours is not None else ()
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
              "property double x\nproperty double y\nproperty double z\n"
              + "".join(f"property uchar {name}\n" for name in names) +
              f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n")
    rows = np.empty(len(faces), np.dtype([("n", "u1"), ("corners", "<i4", 3)]))
    rows["n"], rows["corners"] = 3, faces
    points = np.empty(len(vertices), np.dtype([("at", "<f8", 3), ("colour", "u1", len(names))]))
    points["at"] = vertices
    if colours is not None:
        points["colour"] = colours
    return header.encode() + points.tobytes() + rows.tobytes()


def _obj(vertices: F64, faces: I64, colours: U8 | None = None) -> bytes:
    """The bytes of an OBJ file; colours are `v x y z r g b`, 0 to 1, which common programs read."""
    text = io.BytesIO()
    if colours is None:
        np.savetxt(text, vertices, f"v {_DIGITS} {_DIGITS} {_DIGITS}")
    else:
        rows = np.hstack([vertices, colours / 255])
        np.savetxt(text, rows, f"v {_DIGITS} {_DIGITS} {_DIGITS} %.4g %.4g %.4g")
    np.savetxt(text, faces + 1, "f %d %d %d")
    return text.getvalue()


def _off(vertices: F64, faces: I64, colours: U8 | None = None) -> bytes:
    text = io.BytesIO()
    text.write(f"OFF\n{len(vertices)} {len(faces)} 0\n".encode())
    np.savetxt(text, vertices, f"{_DIGITS} {_DIGITS} {_DIGITS}")
    np.savetxt(text, faces, "3 %d %d %d")
    return text.getvalue()


def _stl(vertices: F64, faces: I64, colours: U8 | None = None) -> bytes:
    rows = np.zeros(len(faces), _STL_RECORD)
    rows["corners"] = vertices[faces]
    return bytes(80) + len(faces).to_bytes(4, "little") + rows.tobytes()


class Writer(Protocol):
    """A function from vertices (N, 3), faces (M, 3) and vertex colours (N, 3) to the bytes of a file."""

    def __call__(self, vertices: F64, faces: I64, colours: U8 | None = None) -> bytes: ...


WRITERS: dict[str, Writer] = {".ply": _ply, ".obj": _obj, ".off": _off, ".stl": _stl}
"""The writer for each suffix. STL holds float32 only; OFF and STL leave colours out."""
