"""The oracle of the rendering tests: float64 ray casting by brute force, and what agreeing with it means."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from ctypes.util import find_library
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest

from ocnf_data.render import render_depth

# A pixel nearer than this (in pixels) to the line of a projected edge may fall on either side of it.
EDGE_TOLERANCE = 1e-9
DEPTH_TOLERANCE = 1e-5  # metres


def _pixel_rays(K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Ray directions (H, W, 3) with z = 1, so that the ray parameter is the depth."""
    v, u = np.mgrid[: size[0], : size[1]].astype(float)
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)


def _cast_rays(vertices: np.ndarray, faces: np.ndarray, K: np.ndarray, R: np.ndarray, T: np.ndarray,
               size: tuple[int, int], near: float = 1e-3) -> np.ndarray:
    """Depth (V, H, W) float64 by Moller-Trumbore over every face; a hit on an edge counts."""
    depth = np.full((len(R), *size), np.inf)
    rays = _pixel_rays(K, size)
    for view in range(len(R)):
        corners = (vertices @ R[view].T + T[view])[faces]
        for a, b, c in corners:
            e1, e2 = b - a, c - a
            p = np.cross(rays, e2)
            det = p @ e1
            with np.errstate(all="ignore"):
                s = -(p @ a) / det
                q = np.cross(-a, e1)
                t, z = rays @ q / det, (e2 @ q) / det
                hit = (det != 0) & (s >= 0) & (t >= 0) & (s + t <= 1) & (z > near)
            depth[view] = np.where(hit, np.minimum(depth[view], z), depth[view])
    return depth


def _distance_to_edges(
    pixels: np.ndarray, corners: np.ndarray, K: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Distance in pixels (P,) of pixels (P, 2) as (row, column) to the nearest line of a projected edge.

    In camera coordinates the edge's line in the image is where rays lie in the plane through the camera's
    centre and the edge, so edges that pass behind the camera need no special case.
    """
    normals = np.cross(corners, np.roll(corners, -1, axis=1)).reshape(-1, 3)
    scale = np.hypot(normals[:, 0] / K[0, 0], normals[:, 1] / K[1, 1])
    lines = normals[scale > 0] / scale[scale > 0, None]
    return np.abs(_pixel_rays(K, size)[tuple(pixels.T)] @ lines.T).min(axis=1)


def _assert_same_depth(depth: np.ndarray, vertices: np.ndarray, faces: np.ndarray, K: np.ndarray,
                       R: np.ndarray, T: np.ndarray, near: float = 1e-3) -> np.ndarray:
    """Depth equals ray casting within 1e-5 m at every pixel that is not within 1e-9 px of an edge."""
    size = depth.shape[1:]
    expected = _cast_rays(vertices, faces, K, R, T, size, near)
    both = np.isfinite(depth) & np.isfinite(expected)
    gap = np.zeros(depth.shape)
    gap[both] = np.abs(depth[both] - expected[both])
    wrong = (gap > DEPTH_TOLERANCE) | (np.isfinite(depth) != np.isfinite(expected))
    for view in np.flatnonzero(wrong.any(axis=(1, 2))):
        pixels = np.argwhere(wrong[view])
        off = _distance_to_edges(pixels, (vertices @ R[view].T + T[view])[faces], K, size)
        worst = pixels[off.argmax()]
        assert off.max() < EDGE_TOLERANCE, (
            f"view {view}, pixel {worst}: {depth[view][tuple(worst)]}, not {expected[view][tuple(worst)]}")
    return expected


@pytest.fixture(scope="session")
def cast_rays() -> Callable[..., np.ndarray]:
    return _cast_rays


@pytest.fixture(scope="session")
def pixel_rays() -> Callable[..., np.ndarray]:
    return _pixel_rays


@pytest.fixture(scope="session")
def assert_same_depth() -> Callable[..., np.ndarray]:
    return _assert_same_depth


@pytest.fixture(scope="session")
def gl_process() -> Iterator[Callable[..., Any]]:
    """Call a function in a process that may open OpenGL, which no process that later forks may do.

    Skips only where there is no libEGL at all: where there is one, it has to work.
    """
    if find_library("EGL") is None:
        pytest.skip("libEGL is not installed (apt-get install libegl1 libgl1 libxrender1)")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        yield lambda function, *args, **kwargs: pool.submit(function, *args, **kwargs).result(timeout=120)


@pytest.fixture(params=["raster", "pyrender"])
def backend(request: pytest.FixtureRequest) -> Callable[..., np.ndarray]:
    """render_depth with each of the backends in turn."""
    if request.param == "raster":
        return render_depth
    call = request.getfixturevalue("gl_process")
    return lambda *args, **kwargs: call(render_depth, *args, backend="pyrender", **kwargs)
