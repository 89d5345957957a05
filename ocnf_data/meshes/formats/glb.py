"""GLB (binary glTF 2.0) through trimesh, after a look at what its accessors claim."""

from __future__ import annotations

import io
import json
import struct
from typing import Any

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.meshes.formats.polygons import check_face_count, check_indices, unreadable

_JSON_CHUNK = 0x4E4F534A
_COMPRESSION = {"KHR_draco_mesh_compression", "EXT_meshopt_compression"}
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
# trimesh copies every accessor; accessors that share bytes are legal, a thousand copies of a file are not.
_MAX_EXPANSION = 16
# Its scene graph takes time quadratic in the number of nodes on a chain.
_MAX_NODES = 10_000


def parse_glb(data: bytes, where: str, max_faces: int) -> tuple[F64, I64]:
    """Vertices (N, 3) and triangles (M, 3) of the scene's triangles, the nodes' transforms applied."""
    _check_claims(_json_header(data, where), len(data), where)
    try:
        import trimesh
    except ImportError as error:
        raise missing_extra("GLB files need trimesh", "generate", where) from error
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False, skip_materials=True)
        placed = [(matrix, scene.geometry[name]) for matrix, name in
                  (scene.graph[node] for node in scene.graph.nodes_geometry)]
    except Exception as error:  # a parser fed hostile bytes raises whatever it likes
        raise unreadable("not a GLB file that trimesh can read", where, found=repr(error)) from error
    meshes = [(matrix, mesh) for matrix, mesh in placed if isinstance(mesh, trimesh.Trimesh)]
    check_face_count(sum(len(mesh.faces) for _, mesh in meshes), max_faces, where)
    vertices, faces, n = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for matrix, mesh in meshes:
        vertices.append(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append(check_indices(np.asarray(mesh.faces), len(mesh.vertices), where) + n)
        n += len(mesh.vertices)
    return np.concatenate(vertices), np.concatenate(faces)


def _json_header(data: bytes, where: str) -> dict[str, Any]:
    if len(data) < 20 or data[:4] != b"glTF":
        raise unreadable("not a GLB file", where, found=data[:20])
    version, _, length, kind = struct.unpack("<4I", data[4:20])
    if version != 2 or kind != _JSON_CHUNK or 20 + length > len(data):
        raise unreadable("not a GLB 2.0 file", where, found=f"version {version}, JSON of {length} bytes")
    try:
        header = json.loads(data[20 : 20 + length])
    except (ValueError, RecursionError) as error:
        raise unreadable("its JSON chunk cannot be read", where, found=error) from error
    if not isinstance(header, dict):
        raise unreadable("its JSON chunk is no object", where)
    return header


def _check_claims(header: dict[str, Any], size: int, where: str) -> None:
    """Refuse accessors that would take far more memory than the file, and what trimesh cannot decode."""
    total = 0
    for accessor in _objects(header, "accessors", where):
        count = accessor.get("count")
        width = _COMPONENT_BYTES.get(_hashable(accessor.get("componentType")), 0)
        n = _COMPONENTS.get(_hashable(accessor.get("type")), 0)
        if type(count) is not int or count < 0 or not width or not n:
            raise unreadable("an accessor makes no sense", where, found=accessor)
        total += count * width * n
    if total > _MAX_EXPANSION * size:
        raise unreadable("the accessors claim more than the file holds", where,
                         found=f"{total} bytes in a file of {size}")
    if len(_objects(header, "nodes", where)) > _MAX_NODES:
        raise OcnfError("too many nodes", code="too_large", where=where, expected=f"at most {_MAX_NODES}")
    if any("uri" in buffer for buffer in _objects(header, "buffers", where)):
        raise unreadable("its data lies outside the file", where, expected="one binary chunk")
    required = header.get("extensionsRequired", [])
    if isinstance(required, list) and _COMPRESSION & {r for r in required if isinstance(r, str)}:
        raise unreadable("compressed geometry is not supported", where, found=required)


def _objects(header: dict[str, Any], name: str, where: str) -> list[dict[str, Any]]:
    value = header.get(name, [])
    if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
        raise unreadable(f"{name} is not a list of objects", where)
    return value


def _hashable(value: object) -> Any:
    return value if isinstance(value, int | str) else None
