"""Triangle meshes as bytes: PLY, OBJ, OFF and STL."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np

from ocnf_data.arrays import F64, I64

_STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_DIGITS = "%.12g"


def _ply(vertices: F64, faces: I64) -> bytes:
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
              "property double x\nproperty double y\nproperty double z\n"
              f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n")
    rows = np.empty(len(faces), np.dtype([("n", "u1"), ("corners", "<i4", 3)]))
    rows["n"], rows["corners"] = 3, faces
    return header.encode() + vertices.astype("<f8").tobytes() + rows.tobytes()


def _obj(vertices: F64, faces: I64) -> bytes:
    text = io.BytesIO()
    np.savetxt(text, vertices, f"v {_DIGITS} {_DIGITS} {_DIGITS}")
    np.savetxt(text, faces + 1, "f %d %d %d")
    return text.getvalue()


def _off(vertices: F64, faces: I64) -> bytes:
    text = io.BytesIO()
    text.write(f"OFF\n{len(vertices)} {len(faces)} 0\n".encode())
    np.savetxt(text, vertices, f"{_DIGITS} {_DIGITS} {_DIGITS}")
    np.savetxt(text, faces, "3 %d %d %d")
    return text.getvalue()


def _stl(vertices: F64, faces: I64) -> bytes:
    rows = np.zeros(len(faces), _STL_RECORD)
    rows["corners"] = vertices[faces]
    return bytes(80) + len(faces).to_bytes(4, "little") + rows.tobytes()


WRITERS: dict[str, Callable[[F64, I64], bytes]] = {".ply": _ply, ".obj": _obj, ".off": _off, ".stl": _stl}
"""By suffix: vertices (N, 3) and faces (M, 3) to the bytes of a file. STL holds float32 only."""
