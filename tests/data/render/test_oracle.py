"""The oracle, before it is used: ray casting against shapes whose depth has a formula."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

from ocnf_data.views.rigs import fibonacci, intrinsics, look_from

K = intrinsics(47.0, 61.0, 33.25, 15.5)
SIZE = (40, 70)


def test_plane(cast_rays: Callable[..., np.ndarray], pixel_rays: Callable[..., np.ndarray]) -> None:
    (R,), (T,) = look_from(np.array([[0.3, -0.2, 0.8]]), 2.0)
    corners = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    depth = cast_rays(corners, np.array([[0, 1, 2], [2, 3, 0]]), K, R[None], T[None], SIZE)[0]
    # (R^T (z ray - T))_z = 0
    np.testing.assert_allclose(depth, (R[:, 2] @ T) / (pixel_rays(K, SIZE) @ R[:, 2]), rtol=1e-12)


def test_box(cast_rays: Callable[..., np.ndarray], pixel_rays: Callable[..., np.ndarray]) -> None:
    box = trimesh.creation.box((1.0, 0.6, 1.4))
    R, T = look_from(fibonacci(5), 2.5)
    depth = cast_rays(np.array(box.vertices), np.array(box.faces), K, R, T, SIZE)
    for i in range(5):
        origin, rays = -R[i].T @ T[i], pixel_rays(K, SIZE) @ R[i]
        slabs = (np.array([-1, 1])[:, None, None, None] * np.array([0.5, 0.3, 0.7]) - origin) / rays
        enter, leave = slabs.min(axis=0).max(axis=-1), slabs.max(axis=0).min(axis=-1)
        np.testing.assert_allclose(depth[i], np.where(enter <= leave, enter, np.inf), rtol=1e-12)


def test_sphere(cast_rays: Callable[..., np.ndarray], pixel_rays: Callable[..., np.ndarray]) -> None:
    # The polyhedron lies between its inscribed sphere and the unit sphere, and so must the depth.
    ball = trimesh.creation.icosphere(3)
    R, T = look_from(fibonacci(2), 3.0)
    depth = cast_rays(np.array(ball.vertices), np.array(ball.faces), K, R, T, SIZE)
    inner = np.linalg.norm(ball.triangles_center, axis=1).min()

    def sphere(radius: float) -> np.ndarray:
        rays = pixel_rays(K, SIZE)
        square, half = (rays**2).sum(axis=-1), 3.0 * rays[..., 2]
        root = half**2 - square * (9.0 - radius**2)
        return np.where(root >= 0, (half - np.sqrt(np.maximum(root, 0))) / square, np.inf)

    for image in depth:
        assert (image >= sphere(1.0) - 1e-12).all()
        assert (image <= sphere(inner) + 1e-12).all()
