"""What is in a mesh file comes out of `read_mesh`, whatever defects real files have."""

import hashlib
import io
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ocnf_data.errors import OcnfError
from ocnf_data.meshes import read_mesh
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.shapes.primitives import ellipsoid

TETRA_V = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4.5]])
TETRA_F = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
_OFF_BODY = "0 0 0\n2 0 0\n0 3 0\n0 0 4.5\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
_OBJ_V = "v 0 0 0\nv 2 0 0\nv 0 3 0\nv 0 0 4.5\n"


def read(tmp_path: Path, name: str, content: str | bytes, **limits):
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_mesh(path, **limits)


@pytest.mark.parametrize("text", [
    "OFF\n4 4 6\n" + _OFF_BODY,
    "OFF4 4 0\n" + _OFF_BODY,  # as real ModelNet40 files begin
    "OFF 4 4 6\n" + _OFF_BODY,
    "OFF\n4 4\n" + _OFF_BODY,
    "\ufeffOFF\n4 4 0\n" + _OFF_BODY,
    "# made by hand\n\nOFF # header\n\n# counts\n4 4 0\n\n" + _OFF_BODY.replace("\n", "\n\n# x\n", 3),
    "OFF\r\n4 4 0\r\n" + _OFF_BODY.replace("\n", "\r\n"),
    "OFF\r4 4 0\r" + _OFF_BODY.replace("\n", "\r"),
    "OFF\n4 4 0\n" + _OFF_BODY.replace("\n", "  \t\n").replace(" ", "\t  "),
    "OFF\n4 4 0\n" + _OFF_BODY.rstrip(),
    "OFF\n4 4 0\n" + _OFF_BODY.replace("3 0 2 1", "3 0 2 1 255 0 0").replace("3 1 2 3", "3 1 2 3 0.5 1"),
    "COFF\n4 4 0\n" + _OFF_BODY.replace("2 0 0\n", "2 0 0 255 0 0 255\n"),
    "NOFF\n4 4 0\n" + _OFF_BODY.replace("0 3 0\n", "0 3 0 0 1 0\n"),
], ids=range(13))
def test_off_with_every_defect(tmp_path, text):
    mesh = read(tmp_path, "x.off", text)
    np.testing.assert_array_equal(mesh.vertices, TETRA_V)
    np.testing.assert_array_equal(mesh.faces, TETRA_F)
    assert mesh.sha256 == hashlib.sha256(text.encode()).hexdigest()
    assert mesh.stats == {"n_vertices": 4, "n_faces": 4, "watertight": True, "components": 1,
                          "degenerate_faces": 0}


@pytest.mark.parametrize("faces", [
    "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n",
    "f -4 -2 -3\nf -4 -3 -1\nf 2 3 4\nf 1 -1 3\n",
    "f 1/7 3/8 2/9\nf 1//5 2//6 4//1\nf 2/1/1 3/2/2 4/3/3\nf 1/-1/-2 4 3\n",
    "usemtl gold\ns off\nf 1 3 \\\n 2\nf 1 2 4 # comment\n  f\t2 3 4\ng \xe9t\xe9\nf 1 4 3\nl 1 2\np 1",
])
@pytest.mark.parametrize("extra", ["", "vt 0.5 nan\nvn 0 0 1\nvp 1 2 3\n"])
def test_obj_forms(tmp_path, faces, extra):
    text = "mtllib /etc/passwd\no thing\n" + _OBJ_V.replace("v 2 0 0", "v 2 0 0 0.1 0.2 0.3") + extra + faces
    mesh = read(tmp_path, "x.obj", text.encode("latin-1"))
    np.testing.assert_array_equal(mesh.vertices, TETRA_V)
    np.testing.assert_array_equal(mesh.faces, TETRA_F)


def test_negative_obj_indices_count_from_the_face_up(tmp_path):
    """Two triangles, each right after its vertices: -1 means another vertex the second time."""
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\n"
    np.testing.assert_array_equal(read(tmp_path, "x.obj", text).faces, [[0, 1, 2], [3, 4, 5]])


def test_polygons_become_fans(tmp_path):
    pentagon = "0 0 0\n2 0 0\n3 1 0\n1 2 0\n-1 1 0\n"
    fan = [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    off = read(tmp_path, "x.off", f"OFF\n5 3 0\n{pentagon}5 0 1 2 3 4\n2 0 1\n4 4 3 2 1 9 9\n")
    np.testing.assert_array_equal(off.faces, [*fan, [4, 3, 2], [4, 2, 1]])
    obj = read(tmp_path, "x.obj", "".join(f"v {p}\n" for p in pentagon.split("\n")[:5]) + "f 1 2 3 4 5\n")
    np.testing.assert_array_equal(obj.faces, fan)
    header = "element vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n"
    header += "property uchar red\nproperty list uchar int vertex_indices\nproperty list uchar float uv\n"
    header += "end_header\n"
    text = f"ply\nformat ascii 1.0\ncomment hi\n{header}{pentagon}9 5 0 1 2 3 4 2 .5 .5\n9 3 2 1 0 0\n"
    ply = read(tmp_path, "a.ply", text)
    np.testing.assert_array_equal(ply.faces, [*fan, [2, 1, 0]])
    for order, name in (("<", "little"), (">", "big")):
        body = np.array(pentagon.split(), dtype=order + "f4").tobytes()
        body += struct.pack(order + "BB5iB2f", 9, 5, 0, 1, 2, 3, 4, 2, .5, .5)
        body += struct.pack(order + "BB3iB", 9, 3, 2, 1, 0, 0)
        mesh = read(tmp_path, "b.ply", f"ply\nformat binary_{name}_endian 1.0\n{header}".encode() + body)
        np.testing.assert_array_equal(mesh.faces, ply.faces)
        np.testing.assert_array_equal(mesh.vertices, ply.vertices)


def test_stl_both_ways(tmp_path):
    corners = TETRA_V[TETRA_F]
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *c.ravel(), 7) for c in corners)
    binary = read(tmp_path, "b.stl", b"solid liar".ljust(80) + struct.pack("<I", 4) + rows)
    text = "solid t\n"
    for triangle in corners:
        points = "".join(f"  vertex {x} {y} {z}\n" for x, y, z in triangle)
        text += f"facet normal 0 0 1\nouter loop\n{points}endloop\nendfacet\n"
    text += "endsolid t\n"
    ascii_ = read(tmp_path, "a.stl", text)
    for mesh in (binary, ascii_):
        np.testing.assert_array_equal(mesh.vertices[mesh.faces], corners)
        assert mesh.stats["watertight"]
        assert mesh.stats["components"] == 1


@pytest.mark.parametrize("begin", [b"made by hand", b"solid liar"])
@pytest.mark.parametrize("after", [b"\n", b"\0\0", b"COLOR=" + 60 * b"x", 99 * b"\0"], ids=range(4))
def test_stl_with_more_behind_its_triangles(tmp_path, begin, after):
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *c.ravel(), 0) for c in TETRA_V[TETRA_F])
    data = begin.ljust(80) + struct.pack("<I", 4) + rows
    mesh = read(tmp_path, "a.stl", data + after)
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], TETRA_V[TETRA_F])
    with pytest.raises(OcnfError) as caught:
        read(tmp_path, "short.stl", data[:-1])
    assert caught.value.code == "unreadable"


def test_glb_with_transforms(tmp_path, valid):
    mesh = read(tmp_path, "x.glb", valid[".glb"])
    np.testing.assert_allclose(mesh.vertices, 2 * TETRA_V + [1, 2, 3])
    np.testing.assert_array_equal(mesh.faces, TETRA_F)


@pytest.mark.parametrize(("mode", "faces"), [
    (5, [[0, 1, 2], [3, 2, 1], [2, 3, 4], [5, 4, 3]]),
    (6, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]),
])
@pytest.mark.parametrize("order", [None, [4, 2, 5, 0, 3, 1], [0, 1]])
def test_glb_strips_and_fans(tmp_path, tetra, mode, faces, order):
    """Triangle strips and fans, with indices and without; two corners make no triangle."""
    points = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 1], [1, 2, 0], [0, 2, 1], [-1, 1, 0]], "<f4")
    used = np.arange(6) if order is None else np.array(order)
    blob = points.tobytes() + used.astype("<u2").tobytes()
    header = tetra.header()
    header["buffers"][0]["byteLength"] = len(blob)
    header["bufferViews"][0]["byteLength"] = points.nbytes
    header["bufferViews"][1].update(byteOffset=points.nbytes, byteLength=2 * len(used))
    header["accessors"][0]["count"], header["accessors"][1]["count"] = 6, len(used)
    primitive = {"attributes": {"POSITION": 0}, "mode": mode}
    header["meshes"][0]["primitives"] = [primitive if order is None else {**primitive, "indices": 1}]
    if len(used) < 3:
        with pytest.raises(OcnfError, match="has no faces"):
            read(tmp_path, "x.glb", tetra.glb(header, blob))
        return
    mesh = read(tmp_path, "x.glb", tetra.glb(header, blob))
    np.testing.assert_array_equal(mesh.vertices, 2.0 * points + [1, 2, 3])
    np.testing.assert_array_equal(mesh.faces, used[faces])


@pytest.mark.parametrize("scenes", [{}, {"scenes": []}, {"scenes": [{"nodes": [2]}]}])
def test_glb_without_a_scene(tmp_path, tetra, scenes):
    """Where none is there, all nodes that have no parent are the scene; else the first one is."""
    header = tetra.header()
    del header["scene"], header["scenes"]
    header["nodes"].append({"mesh": 0})
    mesh = read(tmp_path, "x.glb", tetra.glb({**header, **scenes}))
    placed = [TETRA_V] if scenes.get("scenes") else [TETRA_V, 2 * TETRA_V + [1, 2, 3]]
    np.testing.assert_allclose(mesh.vertices, np.concatenate(placed))


@pytest.mark.parametrize(("kind", "dtype", "one"), [(5120, "<i1", 127), (5121, "<u1", 255),
                                                    (5122, "<i2", 32767), (5123, "<u2", 65535)])
@pytest.mark.parametrize("normalised", [True, False])
def test_glb_of_quantised_positions(tmp_path, tetra, kind, dtype, one, normalised):
    """KHR_mesh_quantization: whole numbers stand for themselves, or normalised for -1 or 0 to 1."""
    header = tetra.header()
    low = 0 if dtype[1] == "u" else np.iinfo(dtype).min  # which stands for -1, as its successor does
    quantised = np.array([[0, 0, 0], [one, 0, low], [0, one, 0], [one // 2, 0, one]])
    rows = np.zeros((4, 4), dtype)  # a stride of four numbers, as alignment asks for
    rows[:, :3] = quantised
    blob = rows.tobytes() + tetra.blob[48:]
    header["buffers"][0]["byteLength"] = len(blob)
    header["bufferViews"][0].update(byteLength=rows.nbytes, byteStride=rows.strides[0])
    header["bufferViews"][1]["byteOffset"] = rows.nbytes
    header["accessors"][0].update(componentType=kind, normalized=normalised)
    header["extensionsRequired"] = ["KHR_mesh_quantization"]
    mesh = read(tmp_path, "x.glb", tetra.glb(header, blob))
    local = np.maximum(quantised / one, -1) if normalised else quantised
    np.testing.assert_allclose(mesh.vertices, 2 * local + [1, 2, 3], rtol=1e-12)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), suffix=st.sampled_from([".ply", ".obj", ".glb", ".off", ".stl"]))
def test_what_is_written_is_read(tmp_path, data, suffix):
    n = data.draw(st.integers(3, 30))
    exponent = data.draw(st.integers(-3, 8))
    grid = data.draw(hnp.arrays(np.int32, (n, 3), elements=st.integers(-9999, 9999)))
    vertices = grid * 10.0**exponent
    vertices[:3] = [[0, 0, 0], [1e4 * 10.0**exponent, 0, 0], [0, 1e4 * 10.0**exponent, 0]]
    m = data.draw(st.integers(1, 20))
    faces = data.draw(hnp.arrays(np.int64, (m, 3), elements=st.integers(0, n - 1)))
    faces[0] = [0, 1, 2]
    if suffix in (".stl", ".glb"):
        vertices = vertices.astype(np.float32).astype(np.float64)
    mesh = read(tmp_path, "x" + suffix.upper(), WRITERS[suffix](vertices, faces))
    np.testing.assert_allclose(mesh.vertices[mesh.faces], vertices[faces], rtol=1e-11)
    if suffix != ".stl":
        np.testing.assert_array_equal(mesh.faces, faces)


FAR = np.array([500_000.0, 4_000_000.0, 100.0])  # UTM, as georeferenced scans have it


@pytest.mark.parametrize("shift", [FAR, -FAR, FAR * 1e-4])
def test_glb_far_from_the_origin_keeps_its_shape(tmp_path, shift):
    """Read by this package and by trimesh, whose scene has the node's place."""
    part = ellipsoid(0.5, 0.4, 0.3, 40)
    vertices = part.vertices + shift
    data = WRITERS[".glb"](vertices, part.faces, np.full((len(vertices), 3), 7, np.uint8))
    scene = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    for found in (read(tmp_path, "x.glb", data).vertices, scene.to_geometry().vertices):
        np.testing.assert_allclose(found, vertices, rtol=0, atol=1e-7)
    near = WRITERS[".glb"](part.vertices + np.array([1.0, 2, 3]), part.faces)
    assert b"translation" in data and b"translation" not in near


def test_stl_refuses_what_float32_would_deform(tmp_path):
    part = ellipsoid(0.5, 0.4, 0.3, 40)
    ends = part.vertices[part.faces[:, :2]]
    edge = np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))
    for far in (0.0, 10.0, 1e3, 1e4, 1e5, 1e6):
        vertices = part.vertices + np.array([far, 0, 0])
        if np.spacing(np.float32(far + 1)) > edge / 4:
            with pytest.raises(OcnfError, match=r"STL: .* too few this far .* Write .ply, .obj or .glb"):
                WRITERS[".stl"](vertices, part.faces)
        elif np.spacing(np.float32(far + 1)) < edge / 16:
            mesh = read(tmp_path, "x.stl", WRITERS[".stl"](vertices, part.faces))
            np.testing.assert_allclose(mesh.vertices[mesh.faces], vertices[part.faces], atol=edge / 16)
    with pytest.raises(OcnfError, match="STL"):
        WRITERS[".stl"](part.vertices + FAR, part.faces)


def test_unreferenced_vertices_stay_and_do_not_count(tmp_path):
    text = "OFF\n5 4 0\n" + _OFF_BODY.replace("3 0 2 1", "1e9 1e9 1e9\n3 0 2 1")
    mesh = read(tmp_path, "x.off", text)
    assert mesh.stats["n_vertices"] == 5
    np.testing.assert_array_equal(mesh.faces, TETRA_F)


def test_statistics(tmp_path):
    two = "OFF\n8 9 0\n" + "0 0 0\n2 0 0\n0 3 0\n0 0 4.5\n10 0 0\n12 0 0\n10 3 0\n10 0 4.5\n"
    two += "3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n3 4 5 6\n3 4 5 7\n3 5 6 7\n3 4 7 6\n3 4 4 5\n"
    stats = read(tmp_path, "x.off", two).stats
    assert stats["components"] == 2
    assert stats["degenerate_faces"] == 1
    assert stats["watertight"]  # windings differ, and a face without area does not open it
    opened = two.replace("8 9 0", "8 8 0").replace("3 4 7 6\n", "")
    assert not read(tmp_path, "y.off", opened).stats["watertight"]


@pytest.mark.skipif("OCNF_DATA" not in os.environ, reason="OCNF_DATA names no folder of real meshes")
def test_real_files_agree_with_trimesh():
    trimesh = pytest.importorskip("trimesh")
    paths = sorted(Path(os.environ["OCNF_DATA"], "meshes").glob("*/test/*.obj"))[::10]
    assert paths
    for path in paths:
        mesh = read_mesh(path)
        other = trimesh.load(path, process=False, force="mesh", skip_materials=True, maintain_order=True)
        np.testing.assert_array_equal(mesh.vertices[mesh.faces], other.vertices[other.faces])


def test_refusal_names_the_file(tmp_path):
    with pytest.raises(OcnfError, match=r"x\.xyz.*expected.*\.obj"):
        read(tmp_path, "x.xyz", "1 2 3")
