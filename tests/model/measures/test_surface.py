"""Distances and samples of surfaces against brute force, and the measures on surfaces that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.octree import GridOctree
from ocnf_data.views.cameras import Views
from ocnf_model.measures.figures import measure_surface
from ocnf_model.measures.reference import Reference, visible
from ocnf_model.measures.surface import Samples, Surface, sample_triangles


def sphere(radius: float, centre=(0.1, -0.05, 0.02)):
    a, b, c = centre
    return lambda x, y, z: np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) - radius


def dense_triangle(triangle: np.ndarray, n: int = 150) -> np.ndarray:
    """Many points of a triangle."""
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    u, v = u.ravel(), v.ravel()
    keep = u + v <= 1 + 1e-12
    u, v = u[keep, None], v[keep, None]
    return triangle[0] + u * (triangle[1] - triangle[0]) + v * (triangle[2] - triangle[0])


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), degenerate=st.sampled_from([None, "segment", "point"]))
def test_the_distance_to_a_triangle_is_that_to_its_nearest_point(seed, degenerate) -> None:
    rng = np.random.default_rng(seed)
    triangle = rng.uniform(-1, 1, (3, 3))
    if degenerate:
        triangle[2] = triangle[0] + (0.4 * (triangle[1] - triangle[0]) if degenerate == "segment" else 0)
        triangle[1] = triangle[0] if degenerate == "point" else triangle[1]
    triangle = triangle.astype(np.float32).astype(np.float64)
    surface = Surface(triangle[None].astype(np.float32), np.array([0, 1]),
                      triangle.mean(axis=0)[None].astype(np.float32))
    points = rng.uniform(-2, 2, (20, 3))
    brute = np.linalg.norm(points[:, None] - dense_triangle(triangle)[None], axis=2).min(axis=1)
    found, normals = surface.nearest(points)
    assert (found <= brute + 1e-6).all() and (found >= brute - 0.02).all()
    lengths = np.linalg.norm(normals, axis=1)
    assert ((np.abs(lengths - 1) < 1e-9) | (lengths == 0)).all()


def test_the_nearest_part_of_a_whole_surface_is_found(solid) -> None:
    surface = Surface.of_octree(solid(sphere(0.7)), 3.0)
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (2000, 3))
    found, normals = surface.nearest(points)
    away = points - [0.1, -0.05, 0.02]
    radii = np.linalg.norm(away, axis=1)
    np.testing.assert_allclose(found, abs(radii - 0.7), atol=2e-3)
    outside = radii > 0.3  # where the direction to the nearest point is clear
    assert (np.abs((normals * away).sum(axis=1) / radii)[outside] > 0.98).all()


def test_samples_spread_evenly_over_the_area() -> None:
    quad = np.array([[[0, 0, 0], [2, 0, 0], [2, 1, 0]], [[0, 0, 0], [2, 1, 0], [0, 1, 0]],
                     [[5, 5, 5], [5, 5, 5], [5, 5, 5.0]]])  # the last has no area
    samples = sample_triangles(quad, 4000)
    assert (samples.points[:, 2] == 0).all() and set(samples.triangles) == {0, 1}
    counts, *_ = np.histogram2d(*samples.points.T[:2], bins=(8, 4), range=((0, 2), (0, 1)))
    assert counts.min() > 80 and counts.max() < 170  # 125 on average
    np.testing.assert_allclose(np.abs(samples.normals @ [0, 0, 1]), 1)
    again = sample_triangles(quad, 4000)
    np.testing.assert_array_equal(samples.points, again.points)
    assert len(sample_triangles(quad[2:])) == 0 and len(sample_triangles(quad[:0])) == 0


@pytest.mark.parametrize("offset", [0.0, 0.6, 1.4])
def test_an_offset_surface_is_as_far_as_it_is_offset(solid, voxel, offset) -> None:
    reference = Reference.of_truth(solid(sphere(0.8)), 3.0, 3 * voxel)
    larger = Surface.of_octree(solid(sphere(0.8 + offset * voxel)), 3.0)
    found = measure_surface(larger, reference, voxel, 3.0)
    assert found.chamfer_voxels == pytest.approx(offset, abs=0.03)
    assert found.chamfer_mm == pytest.approx(1000 * voxel * found.chamfer_voxels)
    within = 1.0 if offset < 1 else 0.0
    assert (found.f_score, found.surface_precision, found.surface_recall) == (within,) * 3
    assert found.normal_consistency > 0.995
    assert math.isnan(found.recall_thin) and math.isnan(found.recall_medium) and found.recall_thick == within


def test_half_of_it_missing_halves_the_recall_and_a_ghost_halves_the_precision(solid, voxel) -> None:
    one, other = sphere(0.3, (0.8, 0, 0)), sphere(0.3, (-0.8, 0, 0))

    def both(x, y, z):
        return np.minimum(one(x, y, z), other(x, y, z))

    whole, part = solid(both), solid(one)
    missing, ghost = (
        measure_surface(Surface.of_octree(found, 3.0), Reference.of_truth(true, 3.0, 3 * voxel), voxel, 3.0)
        for found, true in ((part, whole), (whole, part)))
    for found, whole_share, half_share in ((missing, missing.surface_precision, missing.surface_recall),
                                           (ghost, ghost.surface_recall, ghost.surface_precision)):
        assert whole_share == 1 and half_share == pytest.approx(0.5, abs=0.01)
        assert found.f_score == pytest.approx(2 / 3, abs=0.01)
        # From the other sphere's surface to this one's: its mean distance to the centre, less the radius.
        expected = (1.6 + 0.3**2 / (3 * 1.6) - 0.3) / 2
        assert found.chamfer_mm == pytest.approx(1000 * expected / 2, rel=0.02)


def test_a_surface_at_right_angles_has_other_normals(solid, voxel) -> None:
    flat = Samples(np.array([[0.0, 0, 0]] * 40), np.array([[0.0, 0, 1]] * 40), np.zeros(40, np.int64))
    upright, level = (
        Surface(np.array([triangle], np.float32), np.array([0, 1]), np.zeros((1, 3), np.float32))
        for triangle in ([[0, 0, -1], [0, 1, 0], [0, 0, 1]], [[0, -1, 0], [0, 1, 0], [1, 0, 0]]))
    reference = Reference(level, flat, np.full(40, np.inf))
    assert measure_surface(upright, reference, voxel, 3.0).normal_consistency == pytest.approx(0, abs=1e-6)


def test_nothing_is_far_from_everything(solid, voxel) -> None:
    empty = GridOctree.from_dense(np.ones((1, 64, 64, 64), np.float32))
    reference = Reference.of_truth(solid(sphere(0.8)), 3.0, 3 * voxel)
    found = measure_surface(Surface.of_octree(empty, 3.0), reference, voxel, 3.0)
    assert (found.chamfer_mm, found.f_score, found.normal_consistency, found.recall_thick) == (3000, 0, 0, 0)
    nothing = Reference.of_truth(empty, 3.0, 3 * voxel)
    assert measure_surface(Surface.of_octree(solid(sphere(0.8)), 3.0), nothing, voxel, 3.0).f_score == 0
    both = measure_surface(Surface.of_octree(empty, 3.0), nothing, voxel, 3.0)
    assert (both.chamfer_mm, both.f_score) == (0, 1) and math.isnan(both.recall_thick)


def test_hidden_parts_of_a_mesh_do_not_count(solid, voxel) -> None:
    """A square plate 0.2 m in front of another, seen from one side by one camera."""
    def square(z: float, half: float) -> np.ndarray:
        a, b, c, d = ([-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z])
        return np.array([[a, b, c], [a, c, d]])

    K = np.array([[100.0, 0, 60], [0, 100, 50], [0, 0, 1]])
    views = Views(np.full((1, 101, 121), 2.0), K, np.eye(3)[None], np.array([[0.0, 0, 2]]))
    triangles = np.concatenate([square(0.0, 0.5), square(0.2, 0.5)])  # z grows away from the camera
    points = np.array([[0.1, 0.2, 0], [0.1, 0.2, 0.2], [0.1, 0.2, 0.01], [9, 0, 0], [0, 0, -3]])
    assert visible(points, views, 0.03).tolist() == [True, False, True, False, False]
    reference = Reference.of_mesh(triangles, views, solid(sphere(0.5)), 3.0, 3 * voxel)
    assert (reference.samples.points[:, 2] == 0).all() and 25_000 < len(reference.samples) < 70_000
    far = reference.surface.nearest(np.array([[0.0, 0, 0.2]]))[0]
    assert far == pytest.approx(0.2)
