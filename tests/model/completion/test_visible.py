"""What a view says of a volume, and what is judged, against loops over the voxels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ocnf_data.views.cameras import Views
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST, TRUNCATION, Visible


def loop(view: Views, shape: tuple[int, int, int], voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """(TSDF with NaN unknown, judged), by the words of Firman et al.'s evaluation, voxel by voxel."""
    R, T, K, depth = view.R[0], view.T[0], view.K[0], view.depth[0]
    tsdf, judged = np.full(shape, np.nan), np.zeros(shape, bool)
    for k, j, i in np.ndindex(shape):
        camera = R @ ((np.array([i, j, k]) + 0.5) * voxel) + T
        if camera[2] <= 0:
            continue
        u = round(K[0, 0] * camera[0] / camera[2] + K[0, 2])
        v = round(K[1, 1] * camera[1] / camera[2] + K[1, 2])
        if not (0 <= u < depth.shape[1] and 0 <= v < depth.shape[0]):
            continue
        d = float(depth[v, u])
        if d > 0 and camera[2] - d <= TRUNCATION:
            tsdf[k, j, i] = -min(max(camera[2] - d, -TRUNCATION), TRUNCATION)
        judged[k, j, i] = k >= LOWEST and not tsdf[k, j, i] >= 0
    return tsdf, judged


@pytest.mark.parametrize("seed", range(3))
def test_equals_a_loop_over_the_voxels(seed: int, tabletop: Callable[..., Tabletop]) -> None:
    rng = np.random.default_rng(seed)
    eye = (0.25 + rng.normal(0, 0.3), -0.35, 0.3 + 0.2 * rng.random())  # some voxels outside of the image
    view = tabletop(eye).view
    depth = np.where(rng.random(view.depth.shape) < 0.2, 0, view.depth)
    depth[rng.random(view.depth.shape) < 0.05] = np.inf
    view = view.with_depth(depth.astype(np.float32))
    shape = (12, 17, 14)
    found = Visible.of(view, shape, 0.03)
    tsdf, judged = loop(view, shape, 0.03)
    np.testing.assert_allclose(found.tsdf, tsdf, atol=1e-6)
    np.testing.assert_array_equal(found.judged, judged)
    assert judged.any() and not judged[LOWEST:].all()
    np.testing.assert_array_equal(found.free, tsdf >= 0)


def test_no_measurement_is_judged_and_a_free_ray_is_free(tabletop: Callable[..., Tabletop]) -> None:
    scene = tabletop()
    nothing = Visible.of(scene.view.with_depth(np.zeros_like(scene.view.depth)), scene.shape, scene.voxel)
    assert np.isnan(nothing.tsdf).all() and not nothing.measured.any()
    np.testing.assert_array_equal(nothing.judged[LOWEST:], nothing.in_image[LOWEST:])
    free = Visible.of(scene.view.with_depth(np.full_like(scene.view.depth, np.inf)), scene.shape, scene.voxel)
    assert not free.judged.any() and free.free.sum() == free.in_image.sum() > 0
