"""Damaged and malicious files: our error with a reason code, in bounded memory, and nothing else."""

import contextlib
import functools
import os
import struct
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.meshes import read_mesh
from ocnf_data.meshes.formats import FORMATS

CODES = {"unreadable", "empty", "non_finite", "degenerate", "too_large"}
PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
PLY += "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
TRIANGLE = "0 0 0\n1 0 0\n0 1 0\n"
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 {0}\nvertex 1 0 {0}\nvertex 0 1 {0}\nendloop\nendfacet\n"
BINARY = PLY.format("binary_little_endian", 3, 1).encode()
BINARY += struct.pack("<9fB3i", 0, 0, 0, 1, 0, 0, 0, 1, 0, 3, 0, 1, 2)
STL = "solid a facet\n" + FACET.format(0) + FACET.format(1) + "endsolid a facet\n"


@pytest.fixture(scope="module", autouse=True)
def _warm(valid, tmp_path_factory):
    """Compile and import first: that takes more memory than what is measured."""
    for suffix, content in valid.items():
        path = tmp_path_factory.mktemp("warm") / f"x{suffix}"
        path.write_bytes(content)
        read_mesh(path)


def code_of(path: Path, **limits) -> str:
    """The reason code of the refusal, which has to come without much memory."""
    tracemalloc.start()
    try:
        with pytest.raises(OcnfError) as caught:
            read_mesh(path, **limits)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)
    return caught.value.code


def test_what_those_are_cut_from_is_read(tmp_path) -> None:
    (tmp_path / "a.stl").write_text(STL)
    assert len(read_mesh(tmp_path / "a.stl").faces) == 2
    (tmp_path / "a.stl").write_text(STL.replace("end", "END ").upper())  # as some programs write it
    assert len(read_mesh(tmp_path / "a.stl").faces) == 2
    for name in ("Åke", "файл хата"):
        text = PLY.format("ascii", 3, 1).replace("ply\n", f"ply\ncomment {name}\n", 1)
        (tmp_path / "a.ply").write_text(text + TRIANGLE + "3 0 1 2\n\n", encoding="utf-8")
        assert len(read_mesh(tmp_path / "a.ply").faces) == 1
    (tmp_path / "b.ply").write_bytes(BINARY + b"\r\n")
    assert len(read_mesh(tmp_path / "b.ply").faces) == 1


@pytest.mark.parametrize(("name", "content", "code"), [
    ("a.off", "OFF\n9999999999 9999999999 0\n0 0 0\n", "too_large"),
    ("a.obj", "f\\", "empty"),  # the last line ends in a continuation: found by fuzzing
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\\", "unreadable"),
    ("a.ply", "ply\nelement face 1\nproperty list uchar int vertex_indices\n", "unreadable"),
    ("a.off", "OFF\n9999999999 1 0\n0 0 0\n", "unreadable"),
    ("a.off", "OFF\n3 400000 0\n" + TRIANGLE, "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "4 0 1 2\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "3 0 1 3\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "3 0 1 -1\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "3 0 1 1.5\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "nan 0 1 2\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "-3 0 1 2\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "3 0 1 1e300\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE.replace("1 0 0", "1 0") + "3 0 1 2\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE.replace("1 0 0", "nan 0 0") + "3 0 1 2\n", "non_finite"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE.replace("1 0 0", "1e999 0 0") + "3 0 1 2\n", "non_finite"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE.replace("1 0 0", "one 0 0") + "3 0 1 2\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n", "degenerate"),
    ("a.off", "OFF\n3 1 0\n1 1 1\n1 1 1\n1 1 1\n3 0 1 2\n", "degenerate"),
    ("a.off", "OFF\n3 1 0\n-1e308 0 0\n1e308 0 0\n0 1e308 0\n3 0 1 2\n", "degenerate"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE.replace("1 0 0", "1 0 1.#QNAN") + "3 0 1 2\n", "unreadable"),
    ("a.obj", "v 0 0 0\nv 1 0 1.#INF\nv 0 1 0\nf 1 2 3\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "3.5 0 1 2 2\n", "unreadable"),
    ("a.off", "OFF\n3 1 0\n" + TRIANGLE + "3 0 1 2\n3 0 2 1\n", "unreadable"),
    ("a.off", "OFF\n0 0 0\n", "empty"),
    ("a.off", "OFF\n3 0 0\n" + TRIANGLE, "empty"),
    ("a.off", "", "empty"),
    ("a.obj", "  \n\n \n", "empty"),
    ("a.off", "OFF BINARY\n3 1 0\n" + TRIANGLE, "unreadable"),
    ("a.off", "4OFF\n3 1 0\n" + TRIANGLE, "unreadable"),
    ("a.off", "\xff\xfe\x00garbage", "unreadable"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "unreadable"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", "unreadable"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "unreadable"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999999\n", "unreadable"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 x\n", "unreadable"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 /3\n", "unreadable"),
    ("a.obj", "v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "unreadable"),
    ("a.obj", "v 0 0 0\nv 1 0 inf\nv 0 1 0\nf 1 2 3\n", "non_finite"),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "empty"),
    ("a.ply", PLY.format("ascii", 3, 10**10) + TRIANGLE + "3 0 1 2\n", "unreadable"),
    ("a.ply", PLY.format("binary_little_endian", 10**9, 1), "unreadable"),
    ("a.ply", PLY.format("binary_big_endian", 10**14, 1), "unreadable"),
    ("a.ply", PLY.format("ascii", 3, 1) + TRIANGLE + "200 0 1 2\n", "unreadable"),
    ("a.ply", PLY.format("ascii", 3, 1) + TRIANGLE + "3 0 1 7\n", "unreadable"),
    ("a.ply", PLY.format("ascii", 3, 1) + TRIANGLE, "unreadable"),
    ("a.ply", PLY.format("ascii", 3, 1).replace("end_header", ""), "unreadable"),
    ("a.ply", PLY.format("utf-8", 3, 1) + TRIANGLE, "unreadable"),
    ("a.ply", PLY.format("ascii", 3, 1).replace("float x", "string x") + TRIANGLE, "unreadable"),
    ("a.ply", "ply\nformat ascii 1.0\nelement face 10000000\nend_header\n", "unreadable"),
    ("a.ply", "ply\nproperty float x\nend_header\n", "unreadable"),
    ("a.stl", b"\0" * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 50, "unreadable"),
    ("a.stl", b"solid".ljust(80) + struct.pack("<I", 2**31) + b"\0" * 50, "unreadable"),
    ("a.stl", b"solid".ljust(80) + struct.pack("<I", 2) + b"\0" * 99, "unreadable"),
    ("a.stl", b"solid x\nendsolid x\n", "empty"),
    ("a.stl", b"\0" * 80 + struct.pack("<I", 0), "empty"),
    ("a.stl", b"\0" * 80 + struct.pack("<I", 0) + b"\0" * 50, "unreadable"),
    ("a.stl", b"solid x\nfacet\nvertex 0 0 0\nvertex 0 1 0\nendsolid", "unreadable"),
    ("a.stl", b"solid x\nvertex 0 0 0\nvertex 0 1 0\nvertex 1 x 0\nendsolid", "unreadable"),
    *(("a.stl", STL[:STL.rindex(cut)], "unreadable")
      for cut in ("endsolid", "endfacet", "facet normal", "vertex 0 1 1")),
    ("a.ply", PLY.format("ascii", 3, 1) + TRIANGLE + "3 0 1 2\n3 0 1 2\n", "unreadable"),
    ("a.ply", BINARY + struct.pack("<B3i", 3, 0, 1, 2), "unreadable"),
    ("a.glb", b"glTF", "unreadable"),
    ("a.glb", struct.pack("<4sIIII", b"glTF", 2, 20, 2**31, 0x4E4F534A), "unreadable"),
    ("a.glb", struct.pack("<4sIIII", b"glTF", 2, 120000, 100000, 0x4E4F534A) + b"[" * 100000, "unreadable"),
])
def test_refused_with_a_code(tmp_path, name, content, code):
    path = tmp_path / name
    path.write_bytes(content.encode("latin-1") if isinstance(content, str) else content)
    assert code_of(path) == code


@pytest.mark.parametrize(("change", "code"), [
    (lambda h: h["accessors"][0].update(count=10**12), "unreadable"),
    (lambda h: (h["accessors"][0].update(count=10**9), h["accessors"][0].pop("bufferView")), "unreadable"),
    (lambda h: h["accessors"][0].update(count=-1), "unreadable"),
    (lambda h: h["accessors"][0].update(count=5), "unreadable"),
    (lambda h: h["accessors"][0].update(type=["VEC3"]), "unreadable"),
    (lambda h: h["meshes"][0]["primitives"][0].update(indices=99), "unreadable"),
    (lambda h: h["meshes"][0]["primitives"][0].update(mode=1), "empty"),
    (lambda h: h["buffers"][0].update(uri="file:///dev/zero"), "unreadable"),
    (lambda h: h.update(extensionsRequired=["KHR_draco_mesh_compression"]), "unreadable"),
    (lambda h: h["accessors"][0].update(sparse={"count": 1}), "unreadable"),
    (lambda h: h["accessors"][1].update(sparse={"count": 1}), "unreadable"),
    (lambda h: h.update(nodes=[{}] * 20000), "too_large"),
    (lambda h: h.update(nodes=7), "unreadable"),
])
def test_absurd_glb(tmp_path, tetra, change, code):
    header = tetra.header()
    change(header)
    path = tmp_path / "a.glb"
    path.write_bytes(tetra.glb(header))
    with pytest.raises(OcnfError) as caught:
        read_mesh(path)
    assert caught.value.code == code


@pytest.mark.parametrize("change", [
    {"extensionsRequired": ["EXT_mesh_gpu_instancing"]}, {"extensionsRequired": ["KHR_other_geometry"]},
    {"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]}])
def test_extensions_that_would_change_the_triangles(tmp_path, tetra, change):
    path = tmp_path / "a.glb"
    path.write_bytes(tetra.glb(tetra.header() | {"extensionsRequired": ["KHR_texture_basisu"]}))
    assert len(read_mesh(path).faces) == 4
    path.write_bytes(tetra.glb(tetra.header() | change))
    assert code_of(path) == "unreadable"


def test_many_accessors_of_the_same_bytes(tmp_path, tetra):
    header = tetra.header()
    blob = tetra.blob + bytes(300_000)
    header["bufferViews"].append({"buffer": 0, "byteOffset": 0, "byteLength": len(blob)})
    header["buffers"][0]["byteLength"] = len(blob)
    copies = {"bufferView": 2, "componentType": 5121, "count": len(blob), "type": "SCALAR"}
    header["accessors"] += [copies] * 2000
    path = tmp_path / "a.glb"
    path.write_bytes(tetra.glb(header, blob))
    assert code_of(path) == "unreadable"


def test_glb_nodes_that_form_a_chain(tmp_path, tetra):
    header = tetra.header()
    path = tmp_path / "chain.glb"
    header["nodes"] = [{"children": [i + 1]} for i in range(900)] + [{"mesh": 0}]
    path.write_bytes(tetra.glb(header))
    np.testing.assert_array_equal(read_mesh(path).faces, tetra.faces)


def test_primitives_that_share_an_accessor(tmp_path, tetra):
    """Each counts: 3,000 uses of 120,000 vertices were 8.6 GB out of a file of 1.5 MB."""
    header = tetra.header()
    points = np.random.default_rng(0).random((120_000, 3)).astype("<f4").tobytes()
    header["bufferViews"].append({"buffer": 0, "byteOffset": len(tetra.blob), "byteLength": len(points)})
    header["buffers"][0]["byteLength"] += len(points)
    header["accessors"].append({"bufferView": 2, "componentType": 5126, "count": 120_000, "type": "VEC3"})
    shared = {"attributes": {"POSITION": 2}, "indices": 1}
    path = tmp_path / "a.glb"
    header["meshes"][0]["primitives"] = [shared] * 3000
    path.write_bytes(tetra.glb(header, tetra.blob + points))
    assert code_of(path) == "too_large"
    header["meshes"][0]["primitives"] = [shared]
    header["nodes"] = [{"mesh": 0}] * 3000
    header["scenes"] = [{"nodes": list(range(3000))}]
    path.write_bytes(tetra.glb(header, tetra.blob + points))
    assert code_of(path) == "too_large", "nodes that share a mesh are the same"
    header["scenes"] = [{"nodes": [0, 1, 2]}]
    path.write_bytes(tetra.glb(header, tetra.blob + points))
    assert len(read_mesh(path).vertices) == 3 * 120_000, "a few are what files for real do"


def test_parts_without_end(tmp_path, tetra):
    header = tetra.header()
    header["meshes"][0]["primitives"] *= 500
    header["nodes"] = [{"mesh": 0}] * 500
    header["scenes"] = [{"nodes": list(range(500))}]
    path = tmp_path / "a.glb"
    path.write_bytes(tetra.glb(header))
    assert code_of(path) == "too_large"
    assert code_of(path, max_faces=1000) == "too_large"


def test_ten_thousand_chained_nodes_with_a_mesh_each(tmp_path, tetra):
    """The place of each is the sum of those above it; trimesh's graph took 3 s for 100."""
    n = 10_000
    header = tetra.header()
    header["nodes"] = [{"children": [i + 1], "mesh": 0, "translation": [0, 0, 1]} for i in range(n - 1)]
    header["nodes"].append({"mesh": 0, "translation": [0, 0, 1]})
    path = tmp_path / "a.glb"
    path.write_bytes(tetra.glb(header))
    begin = time.process_time()
    mesh = read_mesh(path)
    assert time.process_time() - begin < 20, "half a second on a machine of its own"
    np.testing.assert_array_equal(mesh.vertices.reshape(n, 4, 3) - tetra.vertices.astype("<f4"),
                                  np.arange(1, n + 1)[:, None, None] * [0.0, 0.0, 1.0] + np.zeros((n, 4, 3)))


@pytest.mark.parametrize("change", [
    lambda h: h["nodes"][1].update(children=[0]),  # a ring
    lambda h: h.update(nodes=[{"children": [1, 1]}, {"mesh": 0}]),
    lambda h: h["nodes"][0].update(translation=[1, 2]),
    lambda h: h["nodes"][0].update(rotation="north"),
    lambda h: h["nodes"][0].update(matrix=[[1]]),
    lambda h: h["nodes"][0].update(children=7),
    lambda h: h["nodes"][0].update(children=[7]),
    lambda h: h["nodes"][1].update(mesh=-1),
    lambda h: h.update(scene=True),
    lambda h: h["meshes"][0].update(primitives={}),
    lambda h: h["accessors"][0].update(byteOffset=-4),
    lambda h: h["accessors"][0].update(type="SCALAR"),  # found by fuzzing
    lambda h: h["accessors"][0].update(type="VEC4", count=3),
    lambda h: h["accessors"][1].update(type="VEC3", count=4),
    lambda h: h["accessors"][1].update(componentType=5126, count=6),
    lambda h: h["bufferViews"][0].update(byteLength=10**9, byteOffset=10**9),
])
def test_a_glb_whose_parts_do_not_fit(tmp_path, tetra, change):
    header = tetra.header()
    change(header)
    path = tmp_path / "a.glb"
    path.write_bytes(tetra.glb(header))
    with pytest.raises(OcnfError, match=path.name) as caught:
        read_mesh(path)
    assert caught.value.code == "unreadable"
    assert "()" not in str(caught.value), "the name of somebody else's exception says nothing"


def test_json_without_end(tmp_path, tetra):
    text = b"[" + b"[]," * (6 * 2**20) + b"[]]"
    path = tmp_path / "a.glb"
    path.write_bytes(struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text)
    with pytest.raises(OcnfError) as caught:
        read_mesh(path)
    assert caught.value.code == "too_large"


def test_elements_that_claim_the_same_bytes(tmp_path):
    """Each of them fits into the file, all of them do not; and a header is not a book."""
    element = "element extra{} 60\nproperty float a\n"
    body = b"\0" * 256
    text = PLY.format("binary_little_endian", 3, 1).replace(
        "end_header", "".join(element.format(i) for i in range(50)) + "end_header")
    path = tmp_path / "a.ply"
    path.write_bytes(text.encode() + body)
    tracemalloc.start()
    with pytest.raises(OcnfError, match="claims more than the file holds"):
        read_mesh(path)
    tracemalloc.stop()
    path.write_bytes(PLY.format("ascii", 3, 1).replace("end_header", "comment x\n" * 400_000
                                                       + "end_header").encode())
    assert code_of(path) == "unreadable"


SECRET = b"root:x:0:0:correct horse battery staple\n"


@pytest.mark.parametrize(("suffix", "content"), [
    (".off", SECRET), (".obj", SECRET), (".stl", SECRET), (".ply", SECRET), (".glb", SECRET),
    (".obj", b"v " + SECRET), (".obj", b"f " + SECRET), (".stl", b"solid\nvertex " + SECRET),
    (".ply", b"ply\n" + SECRET + b"end_header\n"), (".ply", b"ply\nelement " + SECRET + b"end_header\n"),
    (".off", b"OFF 1 1\n" + SECRET), (".glb", b"glTF" + SECRET),
    (".glb", struct.pack("<4sIIII", b"glTF", 2, 99, len(SECRET), 0x4E4F534A) + SECRET),
])
def test_no_content_of_a_file_that_is_no_mesh_is_quoted(tmp_path, suffix, content):
    """A link may lead to any file, and messages end up in failures.jsonl."""
    (tmp_path / "secret").write_bytes(content)
    path = tmp_path / f"a{suffix}"
    path.symlink_to(tmp_path / "secret")
    with pytest.raises(OcnfError) as caught:
        read_mesh(path)
    said = str(caught.value).removeprefix(str(path))
    assert not any(word in said for word in ("root", "correct", "horse", "battery", "staple")), said


def test_glb_accessors_are_not_quoted(tmp_path, tetra):
    header = tetra.header()
    header["accessors"][0].update(count="correct horse")
    header["extensionsRequired"] = ["battery", "KHR_draco_mesh_compression"]
    path = tmp_path / "a.glb"
    path.write_bytes(tetra.glb(header))
    with pytest.raises(OcnfError, match="accessor 0"):
        read_mesh(path)
    header["accessors"][0].update(count=4)
    path.write_bytes(tetra.glb(header))
    with pytest.raises(OcnfError, match=r"found KHR_draco_mesh_compression$"):
        read_mesh(path)


def test_limits(tmp_path, valid):
    path = tmp_path / "a.off"
    path.write_bytes(valid[".off"])
    assert len(read_mesh(path, max_faces=4).faces) == 4
    assert code_of(path, max_faces=3) == "too_large"
    assert code_of(path, max_bytes=path.stat().st_size - 1) == "too_large"
    for suffix in (".ply", ".obj", ".stl"):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(valid[suffix])
        assert code_of(path, max_faces=3) == "too_large"
    polygon = "OFF\n3 1 0\n" + TRIANGLE + "9 " + "0 1 2 " * 3 + "\n"
    path.write_text(polygon)
    assert code_of(path.rename(tmp_path / "b.off"), max_faces=6) == "too_large"


_listeners: list[list[str]] = []


@functools.cache
def _listen() -> None:
    """Python reports every file that it opens, by whatever function; such a hook stays for good."""

    def hear(event: str, args: tuple) -> None:
        if event == "open":
            for opened in _listeners:
                opened.append(os.fsdecode(args[0]) if isinstance(args[0], str | bytes) else str(args[0]))

    sys.addaudithook(hear)


@contextlib.contextmanager
def files_opened():
    """The names of all files that are opened within the block."""
    _listen()
    opened: list[str] = []
    _listeners.append(opened)
    try:
        yield opened
    finally:
        _listeners.remove(opened)


@pytest.mark.parametrize("suffix", sorted(FORMATS))
def test_a_sparse_file_is_not_read(tmp_path, suffix):
    """It is not even opened: its size alone tells."""
    path = tmp_path / f"huge{suffix}"
    with files_opened() as opened:
        with path.open("wb") as file:
            file.truncate(10 * 2**30)
        assert opened == [str(path)]  # nothing is opened unheard
        assert code_of(path) == "too_large"
    assert opened == [str(path)]


def test_things_that_are_no_files(tmp_path):
    (tmp_path / "folder.off").mkdir()
    (tmp_path / "loop.off").symlink_to("loop.off")
    os.mkfifo(tmp_path / "pipe.off")
    (tmp_path / "zero.off").symlink_to("/dev/zero")
    for name in ("folder", "loop", "pipe", "zero", "missing", "nul\0", "x" * 300):
        assert code_of(tmp_path / f"{name}.off") == "unreadable"


def test_no_permission(tmp_path, valid, monkeypatch):
    path = tmp_path / "a.off"
    path.write_bytes(valid[".off"])

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    assert code_of(path) == "unreadable"


def test_no_other_file_is_opened(tmp_path, valid):
    """Material and texture files named in a mesh stay closed."""
    (tmp_path / "a.mtl").write_text("newmtl x\nmap_Kd t.png\n")
    (tmp_path / "t.png").write_bytes(b"not a picture")
    obj, ply, glb = tmp_path / "a.obj", tmp_path / "a.ply", tmp_path / "a.glb"
    obj.write_bytes(b"mtllib a.mtl\nusemtl x\n" + valid[".obj"])
    ply.write_bytes(valid[".ply"].replace(b"element vertex", b"comment TextureFile t.png\nelement vertex"))
    glb.write_bytes(valid[".glb"])
    read_mesh(glb)  # imports trimesh
    with files_opened() as opened:
        for path in (obj, ply, glb):
            read_mesh(path)
    assert opened == [str(obj), str(ply), str(glb)]


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), suffix=st.sampled_from(sorted(FORMATS)))
def test_mutated_files_give_a_valid_mesh_or_our_error(tmp_path, valid, data, suffix):
    content = bytearray(valid[suffix])
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(content)))
        new = data.draw(st.one_of(st.binary(max_size=6), st.sampled_from(
            [b"-", b"9" * 12, b"\n", b" ", b"nan", b"1e999", b"#", b"/", b"\\\n", b"\xff\xff\xff\xff"])))
        content[at : at + data.draw(st.integers(0, 8))] = new
    path = tmp_path / f"x{suffix}"
    path.write_bytes(bytes(content))
    _check(path)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=300), suffix=st.sampled_from(sorted(FORMATS)), keep=st.integers(0, 200))
def test_garbage_gives_our_error(tmp_path, valid, content, suffix, keep):
    path = tmp_path / f"x{suffix}"
    path.write_bytes(valid[suffix][:keep] + content)
    _check(path)


def _check(path: Path) -> None:
    try:
        mesh = read_mesh(path, max_faces=10**6)
    except OcnfError as error:
        assert error.code in CODES
        return
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)
