"""Marching cubes of TSDF octrees: closed, outward, in the right place."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ocnf_data.errors import OcnfError
from ocnf_data.meshes.topology import is_watertight
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface


def volume(vertices, faces) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def centres(shape, extent):
    """x, y, z of the voxel centres of a grid (D, H, W) whose longest axis measures `extent`."""
    s = extent / max(shape)
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5 - n / 2) * s for n in shape), indexing="ij")
    return x, y, z, s


@pytest.mark.parametrize(("shape", "extent", "centre"), [
    ((64, 64, 64), 3.0, (0.0, 0.0, 0.0)), ((48, 64, 56), 2.0, (5.0, -1.0, 0.5))])
def test_sphere_lies_where_it_is(shape, extent, centre):
    x, y, z, s = centres(shape, extent)
    middle, r = np.array([0.1, 0.05, -0.1]) * extent, 0.2 * extent
    distance = np.sqrt((x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2) - r
    octree = GridOctree.from_dense(np.clip(distance / (2 * s), -1, 1).astype(np.float32)[None])
    for level in (0.0, 0.5):
        vertices, faces = octree_surface(octree, extent, level, centre)
        radius = np.linalg.norm(vertices - middle - centre, axis=1)
        np.testing.assert_allclose(radius, r + level * 2 * s, atol=0.05 * s)
        assert is_watertight(faces)
        assert volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * (r + level * 2 * s) ** 3, rel=0.01)


@settings(max_examples=60, deadline=None)
@given(values=hnp.arrays(np.float32, st.sampled_from([(1, 8, 8, 8), (1, 8, 16, 24)]),
                         elements=st.sampled_from(np.float32([-1, -0.5, -1e-4, 0, 1e-7, 0.25, 1]))))
def test_any_octree_gives_a_closed_surface_of_positive_volume(values):
    """Zeros at voxels, checkerboards, solids cut off by the border."""
    vertices, faces = octree_surface(GridOctree.from_dense(values))
    if not (values < 0).any():
        assert len(faces) == 0
        return
    assert is_watertight(faces)
    assert volume(vertices, faces) > 0
    a, b = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    assert len(np.unique(a * len(vertices) + b)) == a.size  # consistently wound
    assert np.abs(vertices).max() <= 1.5 + 3 / max(values.shape)


def test_all_free_and_all_solid():
    free = GridOctree.from_dense(np.ones((1, 8, 8, 8), np.float32))
    assert [len(a) for a in octree_surface(free)] == [0, 0]
    vertices, faces = octree_surface(GridOctree.from_dense(-np.ones((1, 8, 8, 8), np.float32)), 8.0)
    assert is_watertight(faces)
    np.testing.assert_allclose([vertices.min(), vertices.max()], [-4, 4])


def test_four_faces_at_an_edge_are_mended():
    """A torn sheet for which the tables of marching cubes alone leave edges with four faces."""
    from skimage.measure import marching_cubes

    layers = ["++++ ++++ ++++ ++++", "++++ -+-- ---- ----", "++-- +-+- -+-+ ++++", "++-+ ++-+ ++++ ++++"]
    pattern = [[[1.0 if sign == "+" else -1.0 for sign in row] for row in layer.split()] for layer in layers]
    values = np.ones((1, 8, 8, 8), np.float32)
    values[0, 2:6, 2:6, 2:6] = pattern
    assert not is_watertight(marching_cubes(values[0], 0.0)[1].astype(np.int64))
    vertices, faces = octree_surface(GridOctree.from_dense(values))
    assert is_watertight(faces)
    assert volume(vertices, faces) > 0


def test_windows_are_joined_without_a_seam():
    """Noise over several windows of 64 voxels: mended across their sides too."""
    values = np.random.default_rng(0).choice(np.float32([-1, -0.2, 0, 0.3, 1]), size=(1, 8, 136, 72))
    vertices, faces = octree_surface(GridOctree.from_dense(values), 136.0)
    assert is_watertight(faces)
    assert len(np.unique(vertices, axis=0)) == len(vertices)
    apart = np.sort(np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=-1), axis=None)
    assert apart[-1] < 3**0.5 + 1e-6  # no face reaches out of its cell


def test_only_the_trees_that_are_asked_for_are_cut():
    x, y, z, _ = centres((72, 80, 136), 136.0)
    distance = np.sqrt(x**2 + y**2 + z**2) - 30.2
    octree = GridOctree.from_dense(np.clip(distance / 2, -1, 1).astype(np.float32)[None])
    trees = np.zeros((9, 10, 17), bool)
    trees[:, :, :8] = True
    whole, faces = octree_surface(octree, 136.0)
    part, part_faces = octree_surface(octree, 136.0, trees=trees)
    inside = {tuple(np.round(c, 6).ravel()) for c in whole[faces] if c[:, 0].max() < -5}
    found = {tuple(np.round(c, 6).ravel()) for c in part[part_faces]}
    assert inside <= found and len(found) > 1000 and part[:, 0].max() < -2
    assert octree_surface(octree, 136.0, trees=np.zeros_like(trees))[1].shape == (0, 3)


def test_other_encodings_are_refused():
    with pytest.raises(OcnfError, match="10 channels"):
        octree_surface(GridOctree.from_dense(np.zeros((10, 8, 8, 8), np.float32)))
