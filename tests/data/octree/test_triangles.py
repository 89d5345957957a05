"""The triangles of cells: closed, facing outwards, and where marching cubes has them."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_data.octree.triangles import cell_triangles


def of_dense(values: np.ndarray) -> GridOctree:
    return GridOctree.from_dense(np.clip(values, -1, 1).astype(np.float32)[None])


def grid(shape: tuple[int, int, int], extent: float) -> tuple[np.ndarray, ...]:
    """z, y, x of the voxel centres."""
    size = extent / max(shape)
    return tuple(np.meshgrid(*((np.arange(n) + 0.5 - n / 2) * size for n in shape), indexing="ij"))


def areas(triangles: np.ndarray) -> np.ndarray:
    corners = triangles.astype(np.float64)
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), grids=st.tuples(*[st.integers(1, 3)] * 3))
def test_any_field_gives_a_closed_surface_around_what_is_below_0(seed, grids) -> None:
    shape = tuple(8 * n for n in grids)
    values = np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)
    found = cell_triangles(of_dense(values), extent=max(shape))
    _, corners = np.unique(np.round(found.triangles.reshape(-1, 3), 4), axis=0, return_inverse=True)
    faces = corners.reshape(-1, 3)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = Counter(map(tuple, directed.tolist()))
    assert all(edges[a, b] == edges[b, a] for a, b in edges if a != b)
    # By the divergence theorem the volume inside is positive if the triangles face outwards.
    a, b, c = found.triangles.astype(np.float64).transpose(1, 0, 2)
    assert np.einsum("nc,nc->", a, np.cross(b, c)) / 6 > 0
    assert found.first[0] == 0 and found.first[-1] == len(found.triangles)
    assert (np.diff(found.first) >= 1).all() and len(found.centres) == len(found.first) - 1


def test_a_sphere_has_its_area_and_faces_outwards() -> None:
    z, y, x = grid((32, 48, 64), 3.0)
    centre = np.array([0.2, -0.1, 0.05])
    distance = np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2) - 0.5
    found = cell_triangles(of_dense(distance / 0.1), 3.0)
    away = found.triangles.astype(np.float64) - centre
    np.testing.assert_allclose(np.linalg.norm(away, axis=2), 0.5, atol=1.5e-3)
    assert areas(found.triangles).sum() == pytest.approx(4 * np.pi * 0.25, rel=3e-3)
    normals = np.cross(away[:, 1] - away[:, 0], away[:, 2] - away[:, 0])
    assert ((normals * away.mean(axis=1)).sum(axis=1) >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(found.centres - centre, axis=1), 0.5, atol=5e-3)


def test_it_is_the_surface_of_marching_cubes() -> None:
    z, y, x = grid((40, 40, 40), 3.0)
    solid = np.minimum(np.sqrt((x - 0.3) ** 2 + y**2 + z**2) - 0.6,
                       np.maximum(np.maximum(abs(x + 0.5) - 0.3, abs(y) - 0.41), abs(z - 0.02) - 0.2))
    octree = of_dense(solid / 0.16)
    vertices, faces = octree_surface(octree)
    found = cell_triangles(octree)
    assert areas(found.triangles).sum() == pytest.approx(areas(vertices[faces]).sum(), rel=2e-3)
    known = np.unique(np.round(vertices, 3), axis=0)
    mine = np.unique(np.round(found.triangles.reshape(-1, 3).astype(np.float64), 3), axis=0)
    apart = np.abs(mine[:, None] - known[None]).max(axis=2).min(axis=1)
    assert apart.max() < 2.5e-3  # a thirtieth of a voxel: `octree_surface` moves what is 0 at a voxel


def test_a_solid_at_the_border_is_closed_and_nothing_has_no_triangles() -> None:
    full = cell_triangles(of_dense(-np.ones((8, 8, 8))), 8.0)
    assert areas(full.triangles).sum() == pytest.approx(6 * 64, rel=0.1)
    empty = cell_triangles(of_dense(np.ones((8, 16, 8))))
    assert (len(empty.triangles), len(empty.centres), empty.first.tolist()) == (0, 0, [0])
    with pytest.raises(OcnfError, match="not a TSDF"):
        cell_triangles(GridOctree.from_dense(np.zeros((2, 8, 8, 8), np.float32)))
