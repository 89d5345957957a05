"""Every entry of a depth pyramid covers exactly its window, with missing and free pixels kept apart."""

import numpy as np
import pytest

from ocnf_data.fusion import DepthPyramid
from ocnf_data.views.cameras import Views


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (2, 2), (16, 16), (13, 29), (40, 5)])
def test_windows_are_the_extremes_of_their_pixels(size):
    rng = np.random.default_rng(sum(size))
    depth = rng.uniform(0.5, 5.0, (3, *size)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = np.inf
    depth[rng.random(depth.shape) < 0.1] = 0
    eye = np.tile(np.eye(3), (3, 1, 1))
    pyramid = DepthPyramid(Views(depth, eye, eye, np.zeros((3, 3))))

    n_seen = 0
    for level in range(1, len(pyramid.levels)):
        first, width = pyramid.levels[level]
        cell = 2**level
        n_rows = -(-size[0] // cell)
        assert width == -(-size[1] // cell)
        for i in range(n_rows):
            for j in range(width):
                window = depth[:, i * cell : (i + 2) * cell, j * cell : (j + 2) * cell].reshape(3, -1)
                finite = np.where(np.isinf(window), 0, window)
                expected = np.stack([window.min(axis=1), finite.max(axis=1), window.max(axis=1)], axis=-1)
                np.testing.assert_array_equal(pyramid.windows[:, first + i * width + j], expected)
                n_seen += 1
    assert n_seen == pyramid.windows.shape[1]
    assert (n_rows, width) == (1, 1)
