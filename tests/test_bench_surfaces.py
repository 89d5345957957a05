"""What the benches of surfaces measure: flatness of analytic sheets, planes found, frames kept apart."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ocnf_data.views.cameras import Views
from ocnf_model.measures.surface import Surface

VOXEL = 0.02


@pytest.fixture(scope="module")
def bench(load_bench: Callable[[str], Any]) -> Any:
    return load_bench("reconstructions"), load_bench("scans")


def sheet(n: int = 200) -> np.ndarray:
    """(n * n, 3) points of the square [0, 1] x [0, 1] at z = 0."""
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    return np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)


def test_stripes_count_and_a_surface_too_far_out_does_not(bench: Any) -> None:
    reconstructions, _ = bench
    places = sheet(60)
    plane = reconstructions.Plane(np.array([0.0, 0, 1]), 0.0, places)
    points = sheet()
    stripes = points + [0, 0, 0.01] + 0.005 * np.sin(40 * np.pi * points[:, :1]) * [0, 0, 1]
    assert reconstructions.unevenness(stripes, [plane], VOXEL) == pytest.approx(0.005 / 2**0.5, rel=0.02)
    tilted = points + 0.02 * points[:, :1] * [0, 0, 1]
    assert reconstructions.unevenness(tilted, [plane], VOXEL) < 1e-6
    elsewhere = points + np.array([2.0, 0, 0])  # in the plane, but no part of it
    assert np.isnan(reconstructions.unevenness(elsewhere, [plane], VOXEL))
    both = np.concatenate([stripes, points + np.array([0, 0, 0.5])])  # another surface, beyond three voxels
    assert reconstructions.unevenness(both, [plane], VOXEL) == pytest.approx(0.005 / 2**0.5, rel=0.02)


def test_the_largest_planes_of_a_corner_are_its_sides_without_their_edges(bench: Any) -> None:
    reconstructions, _ = bench
    side = sheet(60)
    corner = np.concatenate([side, side[:, [2, 0, 1]], np.random.default_rng(0).random((500, 3))])
    found = reconstructions.largest_planes(corner, VOXEL)
    assert len(found) == 2
    assert sorted(int(np.abs(plane.normal).argmax()) for plane in found) == [0, 2]
    for plane in found:
        assert np.abs(plane.normal).max() > 0.999 and abs(plane.offset) < VOXEL / 2
        across = 2 - int(np.abs(plane.normal).argmax())
        assert plane.places[:, across].min() > 3 * VOXEL  # the other side begins there


def test_a_comparison_is_that_of_two_parallel_sheets(bench: Any) -> None:
    reconstructions, _ = bench
    square = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]]])

    def surface(*heights: float) -> Surface:
        triangles = np.concatenate([square + np.array([0, 0, z]) for z in heights]).astype(np.float32)
        return Surface(triangles, np.arange(len(triangles) + 1), triangles.mean(axis=1))

    asked = sheet(50)
    thin = asked[:, 0] < 0.5
    truth = reconstructions.Truth(surface(0.0), asked, thin, [], VOXEL)
    near, far = (reconstructions.compare(surface(z), truth) for z in (0.015, 0.025))
    assert near.accuracy == pytest.approx(15, rel=1e-3) and near.completeness == pytest.approx(15, rel=1e-3)
    assert (near.f_score, near.thin, far.f_score, far.thin) == (1, 1, 0, 0)
    low = reconstructions.Truth(surface(0.0), asked, thin, [], VOXEL, lambda points: points[:, 2] < 0.1)
    both = surface(0.015, 0.5)
    assert reconstructions.compare(both, low).accuracy == pytest.approx(15, rel=1e-3)
    assert reconstructions.compare(both, truth).accuracy == pytest.approx((15 + 500) / 2, rel=0.01)


@pytest.mark.parametrize(("n", "k", "apart"), [(50, 10, 1), (50, 20, 2), (250, 20, 3), (12, 4, 1)])
def test_frames_of_the_reference_are_no_neighbours_of_the_input(bench: Any, n: int, k: int,
                                                               apart: int) -> None:
    _, scans = bench
    chosen, rest = scans.split_frames(n, k, apart)
    assert len(set(chosen)) == k and len(rest) >= 0.3 * n
    assert min(abs(a - b) for a in chosen for b in rest) == apart + 1


def test_too_few_frames_are_said_to_be(bench: Any) -> None:
    _, scans = bench
    with pytest.raises(SystemExit, match="20 frames are too few for 15"):
        scans.split_frames(20, 15, 2)


def test_what_is_measured_thrice_is_agreed_on_and_what_is_behind_is_not_judged(bench: Any) -> None:
    """Cameras side by side that look along z at a wall of depth 2, of which the last saw nothing."""
    _, scans = bench
    depth = np.full((4, 8, 8), 2.0, np.float32)
    depth[0, :, :4] = 1.0  # something before the left half, in the first frame alone
    depth[3] = 0
    K = np.array([[8.0, 0, 3.5], [0, 8, 3.5], [0, 0, 1]])
    views = Views(depth, K, np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3)))
    points = np.array([[0.1, 0, 2], [-0.1, 0, 2], [-0.1, 0, 1], [0.1, 0, 2.015], [0.1, 0, 2.1], [5, 0, 2]])
    np.testing.assert_array_equal(scans.agreed(points, views, VOXEL, 3), [1, 0, 0, 1, 0, 0])
    assert scans.agreed(points, views, VOXEL, 0).all()
    np.testing.assert_array_equal(scans.looked_through(points, views, VOXEL, 1), [1, 1, 1, 1, 0, 0])
    np.testing.assert_array_equal(scans.looked_through(points, views, VOXEL, 3), [1, 0, 1, 1, 0, 0])
