"""GLB (binary glTF 2.0): trimesh decodes each primitive once, after a look at what the header claims.

The JSON chunk says what is used how often, and every kind of repetition is cheap to write: accessors that
share bytes, primitives that share an accessor, nodes that share a mesh, nodes on a chain. So uses are counted
before anything is decoded, the scene graph is walked here (trimesh's takes time with the cube of a chain's
length), and trimesh gets a header without it, in which every distinct primitive stands once.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.meshes.formats.polygons import check_face_count, check_indices, unreadable

_JSON_CHUNK = 0x4E4F534A
_COMPRESSION = {"KHR_draco_mesh_compression", "EXT_meshopt_compression"}
# What may be required: all else might change where the triangles are.
_HARMLESS = ("KHR_mesh_quantization", "KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_dds",
             "KHR_lights_", "EXT_lights_", "KHR_xmp")
_INSTANCES = "EXT_mesh_gpu_instancing"
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_FLOAT = 5126
_ONE = {5120: 127, 5121: 255, 5122: 32767, 5123: 65535}  # what stands for 1 in normalised positions
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_POSITION_BYTES = 12
# Bytes used several times are legal, a thousand copies of a file are not. Small files may repeat more.
_MAX_EXPANSION = 16
_SMALL = 64 * 2**20
_MAX_NODES = 10_000
_MAX_PARTS = 100_000
_MAX_JSON = 16 * 2**20


class _Primitive(NamedTuple):
    """Indices of accessors, and the mode: equal ones are decoded once."""

    position: int
    indices: int | None
    mode: int


class _Part(NamedTuple):
    """A primitive and its place in the scene, a (4, 4) matrix."""

    primitive: _Primitive
    matrix: F64


def parse_glb(data: bytes, where: str, max_faces: int) -> tuple[F64, I64]:
    """Vertices (N, 3) and triangles (M, 3) of the scene's triangles, the nodes' transforms applied."""
    header, binary = _read_chunks(data, where)
    _check_claims(header, len(data), where)
    parts = _scene_parts(header, len(data), where, max_faces)
    decoded = _decode(header, binary, list(dict.fromkeys(part.primitive for part in parts)), where)
    check_face_count(sum(len(decoded[part.primitive][1]) for part in parts), max_faces, where)
    vertices, faces, n = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for primitive, matrix in parts:
        points, triangles = decoded[primitive]
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite then is refused as a mesh
            vertices.append(points @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append(triangles + n)
        n += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def _read_chunks(data: bytes, where: str) -> tuple[dict[str, Any], bytes]:
    """The JSON chunk's object, and everything behind the chunk."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise unreadable("not a GLB file", where)
    version, _, length, kind = struct.unpack("<4I", data[4:20])
    if version != 2 or kind != _JSON_CHUNK or 20 + length > len(data):
        raise unreadable("not a GLB 2.0 file", where, found=f"version {version}, JSON of {length} bytes")
    if length > _MAX_JSON:
        raise OcnfError("the JSON chunk is too large", code="too_large", where=where, found=f"{length} bytes",
                        expected=f"at most {_MAX_JSON}")
    try:
        header = json.loads(data[20 : 20 + length])
    except (ValueError, RecursionError) as error:
        raise unreadable("its JSON chunk cannot be read", where) from error
    if not isinstance(header, dict):
        raise unreadable("its JSON chunk is no object", where)
    return header, data[20 + length :]


def _check_claims(header: dict[str, Any], size: int, where: str) -> None:
    """Refuse accessors that would take far more memory than the file, and what trimesh cannot decode."""
    total = 0
    for number, accessor in enumerate(_objects(header, "accessors", where)):
        count = accessor.get("count")
        width = _COMPONENT_BYTES.get(_hashable(accessor.get("componentType")), 0)
        n = _COMPONENTS.get(_hashable(accessor.get("type")), 0)
        if type(count) is not int or count < 0 or not width or not n:
            raise unreadable("an accessor makes no sense", where, found=f"accessor {number}")
        total += count * width * n
    if total > _MAX_EXPANSION * size:
        raise unreadable("the accessors claim more than the file holds", where,
                         found=f"{total} bytes in a file of {size}")
    nodes = _objects(header, "nodes", where)
    if len(nodes) > _MAX_NODES:
        raise OcnfError("too many nodes", code="too_large", where=where, expected=f"at most {_MAX_NODES}")
    if any("uri" in buffer for buffer in _objects(header, "buffers", where)):
        raise unreadable("its data lies outside the file", where, expected="one binary chunk")
    required = _list(header, "extensionsRequired", where)
    compressed = [name for name in sorted(_COMPRESSION) if name in required]
    if compressed:
        raise unreadable("compressed geometry is not supported", where, found=", ".join(compressed))
    unknown = [name for name in required if not str(name).startswith(_HARMLESS)]
    if unknown:
        raise unreadable("it needs an extension that is not supported", where,
                         found=", ".join(map(str, unknown))[:200], expected="one exported without it")
    if any(_INSTANCES in node["extensions"] for node in nodes if isinstance(node.get("extensions"), dict)):
        raise unreadable("instances are not supported", where, found=_INSTANCES,
                         expected="one exported with a node for each")


def _scene_parts(header: dict[str, Any], size: int, where: str, max_faces: int) -> list[_Part]:
    """Every primitive at every place it is used, in the scene's order; OcnfError where these are too many."""
    meshes = [list(_primitives(header, mesh, where)) for mesh in _objects(header, "meshes", where)]
    accessors = _objects(header, "accessors", where)
    vertices = [sum(accessors[p.position]["count"] for p in mesh) for mesh in meshes]
    faces = [sum(_n_faces(p, accessors) for p in mesh) for mesh in meshes]
    parts: list[_Part] = []
    n_vertices = n_faces = 0
    for number, matrix in _walk(header, where):
        mesh = _index(number, meshes, "a node's mesh", where)
        n_vertices += vertices[mesh]
        n_faces += faces[mesh]
        if n_vertices * _POSITION_BYTES > max(_MAX_EXPANSION * size, _SMALL):
            raise OcnfError("the scene uses the same vertices too often", code="too_large", where=where,
                            found=f"{n_vertices} vertices or more in a file of {size} bytes",
                            fix="export it without instances, or simplify it")
        check_face_count(n_faces, max_faces, where)
        if len(parts) + len(meshes[mesh]) > _MAX_PARTS:
            raise OcnfError("too many parts", code="too_large", where=where, expected=f"at most {_MAX_PARTS}")
        parts += [_Part(primitive, matrix) for primitive in meshes[mesh]]
    return parts


def _primitives(header: dict[str, Any], mesh: dict[str, Any], where: str) -> Iterator[_Primitive]:
    """The mesh's primitives that are triangles."""
    accessors = _objects(header, "accessors", where)
    for raw in _objects(mesh, "primitives", where):
        mode = raw.get("mode", _TRIANGLES)
        attributes = raw.get("attributes")
        if mode in (_TRIANGLES, _STRIP, _FAN) and isinstance(attributes, dict) and "POSITION" in attributes:
            position = _index(attributes["POSITION"], accessors, "a primitive's POSITION", where)
            if accessors[position]["type"] != "VEC3":
                raise unreadable("positions are not three numbers each", where, found=f"accessor {position}")
            indices = raw.get("indices")
            if indices is not None:
                indices = _index(indices, accessors, "a primitive's indices", where)
                if accessors[indices]["type"] != "SCALAR" or accessors[indices]["componentType"] == _FLOAT:
                    raise unreadable("indices are not whole numbers", where, found=f"accessor {indices}")
            sparse = [a for a in (position, indices) if a is not None and "sparse" in accessors[a]]
            if sparse:  # trimesh would read what lies under the changes
                raise unreadable("sparse accessors are not supported", where, found=f"accessor {sparse[0]}",
                                 expected="one exported without them")
            yield _Primitive(position, indices, mode)


def _n_faces(primitive: _Primitive, accessors: list[dict[str, Any]]) -> int:
    source = primitive.position if primitive.indices is None else primitive.indices
    corners: int = accessors[source]["count"]
    return corners // 3 if primitive.mode == _TRIANGLES else max(corners - 2, 0)


def _walk(header: dict[str, Any], where: str) -> Iterator[tuple[Any, F64]]:
    """(mesh, matrix to the world) of the nodes of the scene that have one; without scenes, of all nodes."""
    nodes, scenes = _objects(header, "nodes", where), _objects(header, "scenes", where)
    if scenes:
        roots = _list(scenes[_index(header.get("scene", 0), scenes, "the scene", where)], "nodes", where)
    else:
        below = {_index(child, nodes, "a node", where)
                 for node in nodes for child in _list(node, "children", where)}
        roots = [number for number in range(len(nodes)) if number not in below]
    queue = [(node, np.eye(4)) for node in roots]
    seen = set()
    while queue:
        number, above = queue.pop()
        number = _index(number, nodes, "a node", where)
        if number in seen:
            raise unreadable("a node has two parents, or is its own ancestor", where, found=f"node {number}")
        seen.add(number)
        node = nodes[number]
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = above @ _local_matrix(node, number, where)
        if "mesh" in node:
            yield node["mesh"], matrix
        queue += [(child, matrix) for child in _list(node, "children", where)]


def _local_matrix(node: dict[str, Any], number: int, where: str) -> F64:
    """(4, 4) from the node to its parent: `matrix`, or translation * rotation * scale."""
    from trimesh import transformations

    try:
        matrix = np.eye(4)
        if "matrix" in node:
            matrix = np.array(node["matrix"], dtype=np.float64).reshape((4, 4)).T
        if "translation" in node:
            matrix = matrix @ transformations.translation_matrix(_numbers(node["translation"], 3))
        if "rotation" in node:
            matrix = matrix @ transformations.quaternion_matrix(_numbers(node["rotation"], 4)[[3, 0, 1, 2]])
        if "scale" in node:
            matrix = matrix @ np.diag([*_numbers(node["scale"], 3), 1.0])
    except (TypeError, ValueError, OverflowError) as error:
        raise unreadable("a node's transform makes no sense", where, found=f"node {number}") from error
    return matrix


def _numbers(value: Any, n: int) -> F64:
    return np.array(value, dtype=np.float64).reshape(n)


def _decode(header: dict[str, Any], binary: bytes, primitives: list[_Primitive],
            where: str) -> dict[_Primitive, tuple[F64, I64]]:
    """Vertices (N, 3) and triangles (M, 3) of each primitive, by trimesh."""
    try:
        import trimesh
    except ImportError as error:
        raise missing_extra("GLB files need trimesh", "generate", where) from error
    used = list(dict.fromkeys(a for p in primitives for a in (p.position, p.indices) if a is not None))
    place = {accessor: i for i, accessor in enumerate(used)}
    meshes = []
    for number, p in enumerate(primitives):
        # trimesh passes over fans: it reads them as strips, which have the same corners in the same order.
        raw = {"attributes": {"POSITION": place[p.position]}, "mode": _STRIP if p.mode == _FAN else p.mode}
        if p.indices is not None:
            raw["indices"] = place[p.indices]
        meshes.append({"name": str(number), "primitives": [raw]})
    accessors = [header["accessors"][a] for a in used]
    small = {name: header.get(name, []) for name in ("buffers", "bufferViews")}
    small |= {"asset": {"version": "2.0"}, "accessors": accessors, "meshes": meshes}
    text = json.dumps(small).encode()
    text += b" " * (-len(text) % 4)
    file = io.BytesIO(struct.pack("<4s4I", b"glTF", 2, 20 + len(text) + len(binary), len(text), _JSON_CHUNK)
                      + text + binary)
    try:
        geometry = trimesh.load_scene(file, file_type="glb", process=False, skip_materials=True).geometry
    except Exception as error:  # a parser fed hostile bytes raises whatever it likes
        raise unreadable("its accessors do not fit its binary chunk", where,
                         found=f"{type(error).__name__} from trimesh") from error
    found: dict[_Primitive, tuple[F64, I64]] = {}
    for number, primitive in enumerate(primitives):
        mesh = geometry.get(str(number))
        if isinstance(mesh, trimesh.Trimesh):
            faces = check_indices(np.asarray(mesh.faces), len(mesh.vertices), where)
            if primitive.mode == _FAN:
                faces = _fan(faces)
            points = np.asarray(mesh.vertices, np.float64)
            found[primitive] = _in_units(points, header["accessors"][primitive.position]), faces
        else:  # no vertex, or what trimesh makes no triangles of
            found[primitive] = np.empty((0, 3)), np.empty((0, 3), np.int64)
    return found


def _fan(strip: I64) -> I64:
    """The triangles (M, 3) of a fan, from those of a strip of its corners, every other of which is turned."""
    faces = strip.copy()
    faces[1::2] = strip[1::2, ::-1]
    faces[:, 0] = faces[:1, 0]
    return faces


def _in_units(points: F64, accessor: dict[str, Any]) -> F64:
    """Positions that are normalised integers (KHR_mesh_quantization) as what they stand for, at least -1."""
    one = _ONE.get(accessor["componentType"])
    return np.maximum(points / one, -1.0) if one and accessor.get("normalized") is True else points


def _objects(parent: dict[str, Any], name: str, where: str) -> list[dict[str, Any]]:
    value = _list(parent, name, where)
    if not all(isinstance(v, dict) for v in value):
        raise unreadable(f"{name} is not a list of objects", where)
    return value


def _list(parent: dict[str, Any], name: str, where: str) -> list[Any]:
    value = parent.get(name, [])
    if not isinstance(value, list):
        raise unreadable(f"{name} is not a list", where)
    return value


def _index(value: Any, of: list[Any], what: str, where: str) -> int:
    if type(value) is not int or not 0 <= value < len(of):
        raise unreadable(f"{what} is not there", where, expected=f"a number below {len(of)}")
    return value


def _hashable(value: object) -> Any:
    return value if isinstance(value, int | str) else None
