"""Errors of poses: how large they are, what they depend on, and what they leave alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import Views
from ocnf_data.views.misalignment import misalign, rotation_of

K = np.array([[50.0, 0, 2], [0, 40, 1], [0, 0, 1]])


def views_at(depth: np.ndarray, seed: int = 0) -> Views:
    """Views of the given depth (V, H, W) from anywhere."""
    random, n = np.random.default_rng(seed), len(depth)
    R = Rotation.from_rotvec(random.normal(size=(n, 3))).as_matrix()
    return Views(depth.astype(np.float32), K, R, random.normal(size=(n, 3)))


@pytest.mark.parametrize("distance", [0.5, 4.0])
def test_what_a_camera_sees_is_moved_by_sigma(distance) -> None:
    """Of 20,000 cameras the standard deviation is within 3 % of it, which is 6 standard errors."""
    depth = np.full((20_000, 1, 3), distance)
    depth[:, 0, 1:] = np.inf, 0  # a free ray and no measurement have no depth to count
    views, sigma = views_at(depth), 0.003
    off = misalign(views, sigma, 5, "item")
    point = np.array([0, 0, distance])
    world = np.einsum("vji,vj->vi", views.R, point - views.T)
    moved = np.einsum("vij,vj->vi", off.R, world) + off.T - point  # (V, 3), in each camera
    wanted = sigma * np.array([1, 1, np.sqrt(0.5)])
    np.testing.assert_allclose(moved.std(axis=0), wanted, rtol=0.03)
    assert (np.abs(moved.mean(axis=0)) < 4 * wanted / np.sqrt(20_000)).all()
    apart = np.corrcoef(np.concatenate([moved[:-1], moved[1:]], axis=1).T) - np.eye(6)
    assert np.abs(apart).max() < 0.03  # neither do axes share anything, nor do neighbours
    turns = Rotation.from_matrix(off.R @ np.swapaxes(views.R, 1, 2)).as_rotvec()
    np.testing.assert_allclose(turns.std(axis=0), sigma / np.sqrt(2) / distance, rtol=0.03)


def test_errors_are_a_pure_function_and_nothing_else_changes() -> None:
    views = views_at(np.random.default_rng(1).uniform(1, 2, (5, 3, 4)))
    off = misalign(views, 0.01, 3, "a")
    np.testing.assert_array_equal(off.depth, views.depth)
    np.testing.assert_array_equal(off.K, views.K)
    again, few = misalign(views, 0.01, 3, "a"), misalign(views.subset([0, 1, 2]), 0.01, 3, "a")
    np.testing.assert_array_equal(again.R, off.R)
    np.testing.assert_array_equal(few.T, off.T[:3])
    for other in (misalign(views, 0.01, 4, "a"), misalign(views, 0.01, 3, "b")):
        assert (np.abs(other.T - off.T).max(axis=1) > 1e-4).all()
    assert misalign(views, 0.0, 3, "a") is views


def test_a_view_that_measured_nothing_keeps_its_pose() -> None:
    depth = np.ones((3, 2, 2))
    depth[1] = [[0, np.inf], [np.inf, 0]]
    views = views_at(depth)
    off = misalign(views, 0.1, 0, "a")
    kept = (off.R == views.R).all(axis=(1, 2)) & (off.T == views.T).all(axis=1)
    assert kept.tolist() == [False, True, False]


@pytest.mark.parametrize("vector", [[0.0, 0, 0], [1e-9, 0, 2e-9], [0.1, -0.2, 0.3], [2.0, 2, -1]])
def test_rotations_are_scipys(vector) -> None:
    np.testing.assert_allclose(rotation_of(np.array(vector)), Rotation.from_rotvec(vector).as_matrix(),
                               atol=1e-15)


@pytest.mark.parametrize("sigma", [-0.1, np.nan, np.inf])
def test_what_is_no_standard_deviation_is_refused(sigma) -> None:
    with pytest.raises(OcnfError, match="sigma"):
        misalign(views_at(np.ones((1, 1, 1))), sigma, 0, "a")
