"""The oracle itself, against what can be worked out by hand, before anything is held against it."""

import numpy as np

from ocnf_data.encodings import Encoding
from ocnf_data.views.cameras import Views


def _frontal(depth, size=(64, 64), focal=16.0):
    K = [[focal, 0, (size[1] - 1) / 2], [0, focal, (size[0] - 1) / 2], [0, 0, 1]]
    image = np.full((1, *size), depth, np.float32)
    return Views(image, np.array(K), np.eye(3)[None], np.array([[0.0, 0.0, 3.0]]))


def test_a_frontal_plane_gives_its_exact_distance(oracle):
    depth = np.float32(2.9)
    dense = oracle(_frontal(depth), (16, 16, 16))
    voxel = 3.0 / 16
    tau = 0.025 * 256 / 16
    distance = float(depth) - ((np.arange(16) + 0.5) * voxel - 1.5 + 3.0)
    expected = np.where(distance >= -tau, np.minimum(distance, tau) / tau, -1.0)
    fused = dense.values[Encoding.TSDF][0]
    np.testing.assert_allclose(fused, np.broadcast_to(expected[:, None, None], fused.shape), atol=1e-12)
    occupied = np.where(distance > voxel, 0.0, 1.0)
    np.testing.assert_array_equal(dense.values[Encoding.OCCUPANCY][0, :, 3, 5], occupied)


def test_the_nearer_bin_gets_the_larger_share(oracle):
    # One voxel layer at distance 0.3 tau: between the centres 0.125 tau (bin 5) and 0.375 tau (bin 6).
    voxel = 3.0 / 8
    tau = 2 * voxel
    depth = 3.0 + voxel / 2 + 0.3 * tau
    dense = oracle(_frontal(depth), (8, 8, 8), truncation=tau)
    bins = dense.values[Encoding.HISTOGRAM][:, 4, 2, 2]
    np.testing.assert_allclose(bins, [0, 0, 0, 0, 0, 0.3, 0.7, 0, 0, 0], atol=1e-6)


def test_free_and_missing_pixels(oracle):
    free = oracle(_frontal(np.inf), (8, 8, 8))
    assert (free.values[Encoding.TSDF] == 1).all()
    assert (free.values[Encoding.HISTOGRAM][9] == 1).all()
    assert (free.values[Encoding.OCCUPANCY] == 0).all()
    missing = oracle(_frontal(0.0), (8, 8, 8))
    assert (missing.values[Encoding.TSDF] == -1).all()
    assert (missing.values[Encoding.HISTOGRAM][0] == 1).all()
    assert (missing.values[Encoding.OCCUPANCY] == 1).all()
