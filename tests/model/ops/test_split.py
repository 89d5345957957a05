"""The structure module against its definition, written out on dense volumes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import max_pool3d

from ocnf_data.errors import OcnfError
from ocnf_model import grid_unpool, split_surface


def near_surface(below: np.ndarray, reach: int) -> np.ndarray:
    """(B, D, H, W) bool: voxels with one of the other side within the Chebyshev distance."""
    def spread(side: np.ndarray) -> np.ndarray:
        return max_pool3d(torch.from_numpy(side).float(), 2 * reach + 1, stride=1, padding=reach).numpy() > 0

    return (spread(below) & ~below) | (spread(~below) & below)


def twice(volume: np.ndarray) -> np.ndarray:
    return volume.repeat(2, 1).repeat(2, 2).repeat(2, 3)


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_structure_and_values_are_those_of_the_definition(data, batches, make_batch, dense) -> None:
    features = data.draw(batches())
    grid, batch_size = features.structure.grid, features.batch_size
    other = make_batch(data.draw(st.integers(0, 99)), grid, batch_size, 1,
                       data.draw(st.sampled_from([0.0, 0.4])))
    own = features.with_features(features.features[:, :1])
    reconstruction = data.draw(st.sampled_from([own, other]))
    band, threshold = data.draw(st.sampled_from([(0, 0.0), (1, 0.0), (2, 0.5), (3, 0.0)]))
    guide = None
    if data.draw(st.booleans()):
        guide = make_batch(5, tuple(2 * n for n in grid), batch_size, 1, 0.3)

    result = split_surface(features, reconstruction, band, guide, threshold)

    below = dense.expand(reconstruction)[:, 0].numpy() < threshold
    wanted = np.where(twice(near_surface(below, -(-band // 2))), 1,
                      dense.widths(grid_unpool(features).structure))
    if guide is not None:
        wanted = np.minimum(wanted, dense.widths(guide.structure))
    np.testing.assert_array_equal(dense.widths(result.structure), dense.coarsest(wanted))
    assert torch.equal(dense.expand(result), dense.expand(grid_unpool(features)))


def test_a_wide_reach_looks_beyond_the_next_tree(make_batch, dense) -> None:
    x = make_batch(0, (1, 1, 3), channels=1, likelihood=0.0)
    x = x.with_features(torch.tensor([[-1.0], [1.0], [1.0]]))
    split = dense.widths(split_surface(x, x, band=18).structure)[0, 0, 0]
    assert (split[: 2 * 17] == 1).all()  # coarse voxels 0..7 below, 8..16 within 9 of them
    assert (split[2 * 17 :] > 1).all()


def test_gradcheck(make_batch) -> None:
    x = make_batch(1, (1, 1, 2), batch_size=2, channels=2)
    reconstruction = make_batch(2, (1, 1, 2), batch_size=2, channels=1)
    assert torch.autograd.gradcheck(lambda f: split_surface(x.with_features(f), reconstruction).features,
                                    x.features.requires_grad_(), fast_mode=True)


def test_what_does_not_fit_is_refused(make_batch) -> None:
    x = make_batch(0, channels=1)
    with pytest.raises(OcnfError, match="one channel"):
        split_surface(x, make_batch(0, channels=2))
    for band in (-1, float("inf"), float("nan")):
        with pytest.raises(OcnfError, match="not a band"):
            split_surface(x, x, band=band)
    with pytest.raises(OcnfError, match="differ in size"):
        split_surface(x, make_batch(0, (1, 1, 2), channels=1))
    with pytest.raises(OcnfError, match="differ in size"):
        split_surface(x, x, guide=make_batch(0, (1, 1, 2)))
