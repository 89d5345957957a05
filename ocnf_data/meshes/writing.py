"""Triangle meshes as bytes: PLY, OBJ, GLB, OFF and STL."""

from __future__ import annotations

import io
import json
from typing import Protocol

import numpy as np

from ocnf_data.arrays import F64, I64, U8
from ocnf_data.errors import OcnfError

_STL_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_DIGITS = "%.12g"
_FAR = 16  # times its half length: where a mesh lies so far away, GLB holds it about its own centre
_STEPS = 8  # of float32 that an edge in STL takes at least, or it is not the edge that was meant


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
    rows, corners = np.zeros(len(faces), _STL_RECORD), vertices[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    if (edges > 0).any():
        check_stl(float(np.abs(corners).max()), float(np.median(edges[edges > 0])))
    rows["corners"] = corners
    return bytes(80) + len(faces).to_bytes(4, "little") + rows.tobytes()


def check_stl(reach: float, edge: float) -> None:
    """Refuse a mesh that STL's 32 bits a coordinate would deform: its neighbours would lie on one step.

    Args:
        reach: the largest coordinate.
        edge: the length of a typical edge, in the same unit.

    Raises:
        OcnfError: the steps of float32 at that coordinate are more than an eighth of the edge.
    """
    step = float(np.spacing(np.float32(reach)))
    if step * _STEPS > edge:
        raise OcnfError("STL holds 32 bits a coordinate, too few this far from the origin", where="STL",
                        found=f"steps of {step:.2g} at {reach:.7g}, for edges of {edge:.2g}",
                        expected=f"steps of at most {edge / _STEPS:.2g}",
                        fix="write .ply, .obj or .glb, which hold it")


def _glb(vertices: F64, faces: I64, colours: U8 | None = None) -> bytes:
    """The bytes of a binary glTF 2.0 file: float32, drawn from both sides.

    Colours are linear in glTF: what is stored in sRGB is converted, to 16 bits so that nothing is lost. The
    scene is turned by no matrix: glTF calls y up, and what a scan calls up is not known. Far from the origin,
    where float32 is coarse, the positions are about the mesh's centre, which the node's translation adds.
    """
    centre = _far_centre(vertices)
    points = (vertices if centre is None else vertices - centre).astype("<f4")
    node = {"mesh": 0} if centre is None else {"mesh": 0, "translation": centre.tolist()}
    parts = [points.tobytes(), faces.astype("<u4").tobytes()]
    bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()} if len(points) else {}
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3", **bounds},
        {"bufferView": 1, "componentType": 5125, "count": faces.size, "type": "SCALAR"}]
    attributes = {"POSITION": 0}
    if colours is not None:
        share = np.arange(256) / 255
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        rgba = np.full((len(points), 4), 65535, "<u2")
        rgba[:, :3] = np.rint(65535 * linear)[colours]
        parts.append(rgba.tobytes())
        attributes["COLOR_0"] = 2
        accessors.append({"bufferView": 2, "componentType": 5123, "normalized": True, "count": len(points),
                          "type": "VEC4"})
    starts = np.cumsum([0, *(len(part) for part in parts)])
    document = {
        "asset": {"version": "2.0", "generator": "ocnf"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1, "material": 0}]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}],
        "accessors": accessors, "buffers": [{"byteLength": int(starts[-1])}],
        "bufferViews": [{"buffer": 0, "byteOffset": int(start), "byteLength": len(part)}
                        for start, part in zip(starts, parts, strict=False)]}
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [(b"JSON", text), (b"BIN\0", b"".join(parts))]  # every part is a multiple of 4 bytes
    body = b"".join(len(data).to_bytes(4, "little") + kind + data for kind, data in chunks)
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


def _far_centre(vertices: F64) -> F64 | None:
    """The centre (3,) of a mesh that lies far from the origin for its size; None where it does not."""
    if not len(vertices):
        return None
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    reach, half = np.abs([low, high]).max(), (high / 2 - low / 2).max()
    return low / 2 + high / 2 if np.isfinite(reach) and reach > _FAR * half else None


class Writer(Protocol):
    """A function from vertices (N, 3), faces (M, 3) and vertex colours (N, 3) to the bytes of a file."""

    def __call__(self, vertices: F64, faces: I64, colours: U8 | None = None) -> bytes: ...


WRITERS: dict[str, Writer] = {".ply": _ply, ".obj": _obj, ".glb": _glb, ".off": _off, ".stl": _stl}
"""The writer for each suffix. GLB and STL hold float32 only, STL refuses what that deforms; OFF and STL
leave colours out."""
