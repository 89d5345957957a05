"""A tetrahedron in every format, and a GLB to be tampered with."""

import copy
import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest

from ocnf_data.meshes.writing import WRITERS

TETRA_V = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4.5]])
TETRA_F = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def make_glb(header: dict, blob: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    if blob:
        chunks += struct.pack("<II", len(blob), 0x004E4942) + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def tetra_gltf() -> tuple[dict, bytes]:
    points, indices = TETRA_V.astype("<f4").tobytes(), TETRA_F.astype("<u2").tobytes()
    header = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "scale": [2, 2, 2]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}], "images": [{"uri": "../../secret.png"}],
        "buffers": [{"byteLength": len(points + indices)}],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(points)},
                        {"buffer": 0, "byteOffset": len(points), "byteLength": len(indices)}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"}],
    }  # fmt: skip
    return header, points + indices


@pytest.fixture(scope="session")
def tetra():
    """`header()` a fresh glTF header, `blob` its data, `glb(header)` the file."""
    header, blob = tetra_gltf()
    return SimpleNamespace(vertices=TETRA_V, faces=TETRA_F, header=lambda: copy.deepcopy(header), blob=blob,
                           glb=lambda changed, data=blob: make_glb(changed, data))


@pytest.fixture(scope="session")
def valid():
    """The bytes of a tetrahedron's file by suffix."""
    return {**{s: write(TETRA_V, TETRA_F) for s, write in WRITERS.items()}, ".glb": make_glb(*tetra_gltf())}
