"""Promise 10: the fused TSDF agrees with analytic bodies, for non-square images and off-centre cameras."""

import numpy as np
import pytest

from ocnf_data.encodings import Encoding
from ocnf_data.fusion import default_truncation, fuse, fuse_tsdf
from ocnf_data.views.cameras import Views

SIZE = 64
VOXEL = 3.0 / SIZE


def _centres():
    axis = (np.arange(SIZE) + 0.5) * VOXEL - 1.5
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    return np.stack([x, y, z], axis=-1)


def _frontal_plane(depth, n_views=1):
    K = np.array([[40.0, 0, 61.3], [0, 55.0, 47.9], [0, 0, 1]])
    R, T = np.tile(np.eye(3), (n_views, 1, 1)), np.tile([0.05, -0.02, 3.0], (n_views, 1))
    return Views(np.full((n_views, 100, 140), depth, np.float32), K, R, T)


@pytest.mark.parametrize("n_views", [1, 3, 7])
@pytest.mark.parametrize("truncation", [None, 0.31, 0.9])
def test_a_frontal_plane_gives_its_distance(truncation, n_views):
    depth = np.float32(2.87)
    views = _frontal_plane(depth, n_views)
    tau = default_truncation(SIZE) if truncation is None else truncation
    distance = float(depth) - (_centres()[..., 2] + 3.0)
    expected = np.where(distance >= -tau, np.minimum(distance, tau) / tau, -1.0)
    u = 40.0 * (_centres()[..., 0] + 0.05) / (_centres()[..., 2] + 3.0) + 61.3
    v = 55.0 * (_centres()[..., 1] - 0.02) / (_centres()[..., 2] + 3.0) + 47.9
    seen = (u > -0.5) & (u < 139.5) & (v > -0.5) & (v < 99.5)
    assert seen.mean() > 0.9
    fused = fuse_tsdf(views, SIZE, truncation=truncation).to_dense()[0]
    np.testing.assert_allclose(fused[seen], expected[seen], atol=2e-6)
    assert (fused[~seen] == -1).all()


@pytest.mark.parametrize("encoding", list(Encoding))
@pytest.mark.parametrize("voxels", [4.0, 9.0, 20.0, 33.0])
def test_free_begins_where_the_encoding_says(oracle, encoding, voxels):
    # Wide truncations on a plane put whole cubes between the thresholds of the encodings (tau, 1.125 tau).
    for depth in (1.9, 2.87, 4.2):
        views = _frontal_plane(np.float32(depth))
        dense = oracle(views, (SIZE,) * 3, truncation=voxels * VOXEL).values[encoding]
        fused = fuse(views, encoding, SIZE, truncation=voxels * VOXEL).to_dense()
        np.testing.assert_allclose(fused, dense, atol=3e-6)


def _true_distance(body, points):
    if body == "sphere":
        return np.linalg.norm(points, axis=-1) - 1.0
    if body == "box":
        outside = np.abs(points) - np.array([0.9, 0.6, 0.4])
        return np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0)
    return np.abs(points @ np.array([0.6, 0.0, 0.8]) - 0.1)


@pytest.mark.parametrize("body", ["sphere", "box", "plane"])
def test_the_sign_and_the_surface_are_the_bodys(scenes, body):
    # A pixel is 3.2 m / 151 px = 21 mm wide, so half of one shifts a slope of up to 60 degrees by 20 mm.
    distance = _true_distance(body, _centres())
    fused = fuse_tsdf(scenes[body], SIZE).to_dense()[0]
    looked_at = np.linalg.norm(_centres(), axis=-1) < 1.3  # the corners of the cube are in few of the images
    distance, fused = distance[looked_at], fused[looked_at]
    # The plane is seen from both sides, and each is free up to the surface.
    outside = fused[distance > 0.1]
    assert (outside > 0).mean() > 0.97
    assert ((outside > 0) | (outside == -1)).mean() > (0.99 if body == "plane" else 0.999)  # -1: hidden
    assert (fused[distance < -0.05] < 0).all()  # there is no inside of a plane
    crossing = np.abs(distance) < 0.5 * VOXEL
    assert np.median(np.abs(fused[crossing])) < 0.5


@pytest.mark.parametrize("body", ["sphere", "box"])
def test_one_view_measures_along_its_axis(scenes, body):
    """Near the surface a single view's TSDF is depth minus z_c, to what half a pixel of slope can do."""
    views = scenes[body].subset([3])
    fused = fuse_tsdf(views, SIZE).to_dense()[0]
    tau = default_truncation(SIZE)
    points = _centres().reshape(-1, 3) @ views.R[0].T + views.T[0]
    u, v = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    depth = _first_hit(body, -views.R[0].T @ views.T[0], rays @ views.R[0])
    difference = (depth - points[:, 2]) / tau
    inner = (np.abs(difference) < 0.9) & (fused.ravel() > -1)
    assert inner.sum() > 1000
    error = np.abs(fused.ravel() - difference)[inner]
    assert np.median(error) < 0.1
    assert np.mean(error < 0.5) > 0.95


def _first_hit(body, origin, directions):
    if body == "sphere":
        a, b = (directions**2).sum(-1), directions @ origin
        with np.errstate(invalid="ignore"):
            hit = (-b - np.sqrt(b * b - a * (origin @ origin - 1.0))) / a
        return np.where(np.isnan(hit), np.inf, hit)
    half = np.array([0.9, 0.6, 0.4])
    t0, t1 = (-half - origin) / directions, (half - origin) / directions
    enter, leave = np.minimum(t0, t1).max(-1), np.maximum(t0, t1).min(-1)
    return np.where(enter <= leave, enter, np.inf)
