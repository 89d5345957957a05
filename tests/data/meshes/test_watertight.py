"""`make_watertight` closes what is open, whatever its winding, in its own coordinates."""

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.meshes import read_mesh
from ocnf_data.meshes.topology import is_watertight
from ocnf_data.meshes.watertight import make_watertight, watertight_path
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.shapes import make_shape
from ocnf_data.shapes.primitives import box, ellipsoid

RESOLUTION = 64


def volume(vertices, faces) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def damaged(part, scale, shift):
    """Every third face turned round and one taken out: a hole smaller than a voxel's view into the inside."""
    faces = part.faces.copy()
    faces[::3] = faces[::3, ::-1]
    return part.vertices * scale + shift, faces[1:]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 4.6e8])
def test_a_damaged_sphere_closes_in_its_own_coordinates(scale):
    shift = np.array([10.0, -20.0, 5.0]) * scale
    vertices, faces = damaged(ellipsoid(1, 0.8, 0.6, 100), scale, shift)
    closed, surface_faces = make_watertight(vertices, faces, RESOLUTION, level=0)
    assert is_watertight(surface_faces)
    assert volume(closed, surface_faces) == pytest.approx(4 / 3 * np.pi * 0.48 * scale**3, rel=0.02)
    voxel = 2 * scale / 0.95 / RESOLUTION
    np.testing.assert_allclose(closed.min(axis=0), vertices.min(axis=0), atol=voxel)
    np.testing.assert_allclose(closed.max(axis=0), vertices.max(axis=0), atol=voxel)


def test_hidden_parts_vanish_and_solids_merge():
    """A box in a box, and one that overlaps it: the union's outside is left, in one piece."""
    parts = [box(2, 2, 2), box(1, 1, 1).move(z=0.5), box(1, 1, 3).move(x=1)]
    vertices = np.concatenate([p.vertices for p in parts])
    faces = np.concatenate([p.faces + 8 * i for i, p in enumerate(parts)])
    closed, surface_faces = make_watertight(vertices, faces, RESOLUTION, level=0)
    assert is_watertight(surface_faces)
    # 8 + 3 less the overlap of 0.5 x 1 x 2
    assert volume(closed, surface_faces) == pytest.approx(10, rel=0.03)


def test_a_sheet_becomes_a_slab_of_about_a_voxel():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    closed, surface_faces = make_watertight(vertices, np.array([[0, 1, 2], [0, 2, 3]]), 128)
    voxel = 1 / 0.95 / 128
    assert is_watertight(surface_faces)
    assert 0.5 * voxel < volume(closed, surface_faces) < 3 * voxel
    assert len(np.unique(np.round(closed[:, :2] / 0.05), axis=0)) > 350  # whole: no hole anywhere


@pytest.mark.parametrize("category", ["chair", "plant", "lamp"])
def test_messy_shapes_close(category):
    mesh = make_shape(category, 0, 3, "test")
    vertices, faces = make_watertight(mesh.vertices, mesh.faces, RESOLUTION)
    assert is_watertight(faces)
    assert volume(vertices, faces) > 0
    np.testing.assert_array_equal(np.unique(faces), np.arange(len(vertices)))


@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_one_file(tmp_path, suffix):
    part = ellipsoid(1, 1, 1, 60)
    source, out = tmp_path / "in.off", tmp_path / "made" / f"out{suffix}"
    source.write_bytes(WRITERS[".off"](part.vertices, part.faces[:-1]))
    report = watertight_path(source, out, RESOLUTION)
    assert report.written == [out]
    assert report.failures == []
    mesh = read_mesh(out)
    assert mesh.stats["watertight"]
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(4 / 3 * np.pi, rel=0.1)
    assert list(out.parent.iterdir()) == [out]  # nothing temporary is left


@pytest.mark.parametrize("jobs", [1, 2, 10_000_000])
def test_a_folder_with_a_bad_file(tmp_path, jobs):
    part = box(1, 2, 3)
    source, out = tmp_path / "in", tmp_path / "out"
    (source / "deep er").mkdir(parents=True)
    for name in ("a.off", "deep er/b.obj", "deep er/b.ply"):
        path = source / name
        path.write_bytes(WRITERS[path.suffix](part.vertices, part.faces))
    (source / "bad.off").write_text("OFF\n9 9 9\n")
    (source / "notes.txt").write_text("no mesh")
    seen = []
    report = watertight_path(source, out, 32, jobs=jobs, progress=lambda *counts: seen.append(counts))
    names = [p.relative_to(out).as_posix() for p in report.written]
    assert names == ["a.ply", "deep er/b.obj.ply", "deep er/b.ply.ply"]
    assert [(p.name, e.code) for p, e in report.failures] == [("bad.off", "unreadable")]
    assert seen == [(i, 4) for i in range(1, 5)]
    assert sorted(p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()) == names


def test_neither_hidden_files_nor_its_own_output_are_sources(tmp_path):
    part = box(1, 2, 3)
    for name in ("a.off", ".a.off", "._b.off", ".trash/c.off"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(WRITERS[".off"](part.vertices, part.faces))
    (tmp_path / "out").mkdir()
    for out in (tmp_path / "out", tmp_path / "out", tmp_path / "out" / ".." / "out"):
        report = watertight_path(tmp_path, out, 16, suffix=".off")
        assert [p.relative_to(out).as_posix() for p in report.written] == ["a.off"]
        assert report.failures == []
    with pytest.raises(OcnfError, match="is the folder of the meshes"):
        watertight_path(tmp_path, tmp_path / "out" / "..", 16)
    report = watertight_path(tmp_path / "out", tmp_path, 16)
    assert report.written == [tmp_path / "a.ply"]  # the folder above may be the output
    (tmp_path / "a.off").unlink()
    (tmp_path / "a.ply").unlink()
    with pytest.raises(OcnfError, match="holds no mesh"):
        watertight_path(tmp_path, tmp_path / "out", 16)


@pytest.mark.parametrize(("vertices", "faces", "code", "message"), [
    (np.eye(3), [[0, 1, 3]], "invalid", "faces: a face index is out of range; found 0 to 3"),
    (np.eye(3), [[0, 1, -1]], "invalid", "faces: a face index is out of range; found -1 to 1"),
    (np.eye(3), [[0, 1]], "invalid", "faces: faces have the wrong shape"),
    (np.eye(3), [[0, 1, 2.5]], "invalid", "faces: faces have the wrong shape or type"),
    (np.eye(2), [[0, 1, 0]], "invalid", "vertices: vertices have the wrong shape"),
    (np.eye(3) * np.nan, [[0, 1, 2]], "non_finite", "a vertex is not finite"),
    (np.eye(3), [], "empty", "has no faces"),
    (np.empty((0, 3)), np.empty((0, 3), np.int64), "empty", "has no faces"),
])
def test_arrays_that_are_no_mesh(vertices, faces, code, message):
    with pytest.raises(OcnfError, match=f"make_watertight: .*{message}") as caught:
        make_watertight(vertices, faces, RESOLUTION)
    assert caught.value.code == code


def test_what_cannot_be_done_is_said(tmp_path):
    part = box(1, 2, 3)
    source = tmp_path / "in.ply"
    source.write_bytes(WRITERS[".ply"](part.vertices, part.faces))
    with pytest.raises(OcnfError, match="overwrite its own source"):
        watertight_path(source, tmp_path)
    with pytest.raises(OcnfError, match=r"\.vtk"):
        watertight_path(source, tmp_path / "x.vtk")
    (tmp_path / "none").mkdir()
    with pytest.raises(OcnfError, match="holds no mesh"):
        watertight_path(tmp_path / "none", tmp_path / "out")
    for missing in ("missing.off", "missing"):
        with pytest.raises(OcnfError, match="no such file or folder"):
            watertight_path(tmp_path / missing, tmp_path / "out.ply")
    for level in (-1, 1, 5, float("nan")):
        with pytest.raises(OcnfError, match="level"):
            make_watertight(part.vertices, part.faces, RESOLUTION, level)
    for refused in (make_watertight, lambda *_: watertight_path(source, tmp_path / "out.ply", 100)):
        with pytest.raises(OcnfError, match="resolution"):
            refused(part.vertices, part.faces, 100)
