"""Both backends against formulas: plane, sphere and box, non-square images, off-centre principal points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from ocnf_data.views.rigs import fibonacci, intrinsics, look_from

Render = Callable[..., np.ndarray]
CAMERAS = {
    "paper": (intrinsics(351.0, 351.0, 320.0, 240.0), (480, 640)),
    "off centre": (intrinsics(210.0, 150.0, 81.3, 140.6), (200, 333)),
    "upright": (intrinsics(150.0, 180.0, 60.5, 199.0), (301, 97)),
}
# Metres. A 24-bit depth buffer resolves z^2 (far - near) / (far near) 2^-24; at these distances that is 2e-6.
TOLERANCE = 1e-5


@pytest.fixture(params=CAMERAS)
def camera(request: pytest.FixtureRequest) -> tuple[np.ndarray, tuple[int, int]]:
    return CAMERAS[request.param]


def _assert_close(depth: np.ndarray, expected: np.ndarray, silhouette: int) -> None:
    """Equal within TOLERANCE but for a number of pixels on the silhouette."""
    with np.errstate(invalid="ignore"):
        differ = (np.isfinite(depth) != np.isfinite(expected)) | (np.abs(depth - expected) > TOLERANCE)
    assert differ.sum() <= silhouette
    assert np.isfinite(expected).mean() > 0.02


def test_plane(backend: Render, camera: tuple, pixel_rays: Render) -> None:
    K, size = camera
    R, T = look_from(np.array([[0.3, -0.2, 0.8], [-0.1, 0.3, -0.9]]), 2.0)
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    depth = backend(corners, [[0, 1, 2], [2, 3, 0]], K, R, T, size)
    for i in range(2):
        rays = pixel_rays(K, size)
        expected = (R[i][:, 2] @ T[i]) / (rays @ R[i][:, 2])
        points = (rays * expected[..., None] - T[i]) @ R[i]
        on_it = (np.abs(points) <= 1).all(axis=-1) & (expected > 0)
        _assert_close(depth[i], np.where(on_it, expected, np.inf), silhouette=6)


def test_box(backend: Render, camera: tuple, pixel_rays: Render) -> None:
    K, size = camera
    box = trimesh.creation.box((1.0, 0.6, 1.4))
    R, T = look_from(fibonacci(3), 2.5)
    depth = backend(box.vertices, box.faces, K, R, T, size)
    for i in range(3):
        origin, rays = -R[i].T @ T[i], pixel_rays(K, size) @ R[i]
        with np.errstate(divide="ignore"):
            slabs = (np.array([-1, 1])[:, None, None, None] * np.array([0.5, 0.3, 0.7]) - origin) / rays
        enter, leave = slabs.min(axis=0).max(axis=-1), slabs.max(axis=0).min(axis=-1)
        _assert_close(depth[i], np.where(enter <= leave, enter, np.inf), silhouette=6)


def test_sphere(backend: Render, camera: tuple, pixel_rays: Render) -> None:
    """A fine polyhedron lies between two spheres 1e-4 apart, and so does its depth."""
    K, size = camera
    ball = trimesh.creation.icosphere(6)
    inner = np.linalg.norm(ball.triangles_center, axis=1).min()
    assert inner > 0.9999
    R, T = look_from(fibonacci(2), 3.0)
    depth = backend(ball.vertices, ball.faces, K, R, T, size)
    rays = pixel_rays(K, size)
    square, half = (rays**2).sum(axis=-1), 3.0 * rays[..., 2]
    outer_root, inner_root = (half**2 - square * (9.0 - r**2) for r in (1.0, inner))
    for image in depth:
        np.testing.assert_array_equal(np.isposinf(image[outer_root < 0]), True)
        sure = inner_root > 0
        nearest, farthest = ((half[sure] - np.sqrt(r[sure])) / square[sure] for r in (outer_root, inner_root))
        assert (image[sure] >= nearest - TOLERANCE).all()
        assert (image[sure] <= farthest + TOLERANCE).all()
