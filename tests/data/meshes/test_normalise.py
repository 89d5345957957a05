"""Meshes are centred and scaled by the box of the vertices that faces use; folders are listed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ocnf_data.errors import OcnfError
from ocnf_data.meshes import Mesh, list_modelnet, normalise
from ocnf_data.meshes.topology import mesh_stats


def mesh_of(vertices, faces) -> Mesh:
    vertices, faces = np.asarray(vertices, float), np.asarray(faces)
    return Mesh(vertices, faces, "", mesh_stats(vertices, faces))


@given(grid=hnp.arrays(np.int32, (12, 3), elements=st.integers(-1000, 1000)), exponent=st.integers(-6, 6),
       extent=st.floats(0.5, 10), padding=st.floats(0, 0.5))
def test_normalised(grid, exponent, extent, padding):
    vertices = grid * 10.0**exponent
    vertices[0, 0] = vertices[1, 0] + 500 * 10.0**exponent
    faces = np.arange(9).reshape(3, 3)  # the last three vertices are not referenced
    points, cube = normalise(mesh_of(vertices, faces), extent, padding)
    used = points[:9]
    np.testing.assert_allclose(np.ptp(used, axis=0).max(), extent * (1 - padding), rtol=1e-12)
    np.testing.assert_allclose(used.min(axis=0) + used.max(axis=0), 0, atol=1e-12 * extent)
    assert points.shape == vertices.shape
    np.testing.assert_allclose(cube.invert(points), vertices, atol=1e-11 * np.abs(vertices).max())
    # A similarity: lengths keep their ratios.
    np.testing.assert_allclose(np.linalg.norm(points[1] - points[5]),
                               cube.scale * np.linalg.norm(vertices[1] - vertices[5]), atol=1e-11 * extent)


@pytest.mark.parametrize("scale", [1e-3, 1, 4.6e8])
def test_scales_and_offsets(scale):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 0.5, 0]]) * scale + 7 * scale
    points, _ = normalise(mesh_of(vertices, [[0, 1, 2]]))
    expected = [[-1.425, -0.7125, 0], [1.425, -0.7125, 0], [-1.425, 0.7125, 0]]
    np.testing.assert_allclose(points, expected, atol=1e-9)


@pytest.mark.parametrize("vertices", [np.zeros((3, 3)), np.full((3, 3), 5.0), np.eye(3) * 1e-200,
                                      np.eye(3) * 1e200])
def test_no_extent(vertices):
    with pytest.raises(OcnfError) as caught, np.errstate(over="ignore"):
        normalise(mesh_of(vertices, [[0, 1, 2]]))
    assert caught.value.code == "degenerate"


def test_listing_is_sorted_by_path(tmp_path):
    folder = tmp_path / "chair" / "train"
    folder.mkdir(parents=True)
    meshes = ("chair_10.off", "chair_9.off", "Chair.OBJ", "a b.ply", "é.stl")
    for name in (*meshes, ".hidden.off", "notes.txt", "x.mtl"):
        (folder / name).touch()
    (folder / "deeper").mkdir()
    listed = list_modelnet(tmp_path, "chair", "train")
    assert listed == ["chair/train/Chair.OBJ", "chair/train/a b.ply", "chair/train/chair_10.off",
                      "chair/train/chair_9.off", "chair/train/é.stl"]


def test_missing_and_empty_folders_are_named(tmp_path):
    (tmp_path / "chair" / "test").mkdir(parents=True)
    with pytest.raises(OcnfError, match="chair") as caught:
        list_modelnet(tmp_path, "chair", "test")
    assert caught.value.code == "empty"
    with pytest.raises(OcnfError, match=r"sofa.*expected one of chair") as caught:
        list_modelnet(tmp_path, "sofa", "test")
    assert caught.value.code == "missing"
    with pytest.raises(OcnfError, match="nowhere"):
        list_modelnet(tmp_path / "nowhere", "sofa", "test")
