"""Boxes of trees against slices of the dense volume."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_model.octree.crop import crop


@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_it_is_the_slice_of_the_dense_volume(data, make_batch, dense) -> None:
    grid = data.draw(st.tuples(*[st.integers(1, 3)] * 3))
    batch_size = data.draw(st.integers(1, 3))
    x = make_batch(data.draw(st.integers(0, 99)), grid, batch_size, 2, data.draw(st.sampled_from([0.0, 0.4])))
    shape = tuple(data.draw(st.integers(1, n)) for n in grid)
    grids = data.draw(st.lists(st.integers(0, batch_size - 1), min_size=1, max_size=4))
    corners = np.array([[data.draw(st.integers(0, n - m)) for n, m in zip(grid, shape, strict=True)]
                        for _ in grids])
    boxes = crop(x, corners, shape, grids)
    volume, widths = dense.expand(x), dense.widths(x.structure)
    for i, (b, corner) in enumerate(zip(grids, corners, strict=True)):
        inside = tuple(slice(8 * c, 8 * (c + n)) for c, n in zip(corner, shape, strict=True))
        assert torch.equal(dense.expand(boxes)[i], volume[b][:, *inside])
        np.testing.assert_array_equal(dense.widths(boxes.structure)[i], widths[b][inside])


def test_gradients_go_to_the_leaves_of_the_box_alone(make_batch) -> None:
    x = make_batch(1, (2, 2, 2), 2, 1, 0.4)
    features = x.features.clone().requires_grad_()
    marked = x.with_features(features)
    crop(marked, np.array([[1, 0, 1]]), (1, 2, 1), [1]).features.sum().backward()
    touched = crop(x.with_features(features.grad), np.array([[1, 0, 1]]), (1, 2, 1), [1]).features
    assert (touched == 1).all() and features.grad.sum() == len(touched)


@pytest.mark.parametrize(("corner", "shape"), [((0, 0, 1), (1, 1, 2)), ((-1, 0, 0), (1, 1, 1)),
                                               ((0, 0, 0), (0, 1, 1))])
def test_a_box_beyond_the_grid_is_refused(corner, shape, make_batch) -> None:
    with pytest.raises(OcnfError, match="does not lie in the grid"):
        crop(make_batch(0, (2, 2, 2)), np.array([corner]), shape)
