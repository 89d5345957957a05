"""Pooling, unpooling and concatenation equal the dense ones, structures included."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import avg_pool3d, max_pool3d

from ocnf_data.errors import OcnfError
from ocnf_model import OctreeBatch, concat, grid_pool, grid_unpool

few = settings(max_examples=25, deadline=None)


def upsample(volume: torch.Tensor) -> torch.Tensor:
    return volume.repeat_interleave(2, 2).repeat_interleave(2, 3).repeat_interleave(2, 4)


@few
@given(data=st.data())
@pytest.mark.parametrize(("kind", "pool"), [("max", max_pool3d), ("mean", avg_pool3d)])
def test_pool_and_its_gradient_equal_the_dense_one(kind, pool, data, batches, dense) -> None:
    x = data.draw(batches(even=True))
    features = x.features.clone().requires_grad_()
    ours = grid_pool(x.with_features(features), kind)
    theirs = pool(dense.expand(x.with_features(features)), 2)
    torch.testing.assert_close(dense.expand(ours), theirs, rtol=0, atol=1e-14)
    fine = dense.widths(x.structure)[:, ::2, ::2, ::2]
    np.testing.assert_array_equal(dense.widths(ours.structure), np.maximum(fine // 2, 1))
    upstream = torch.randn_like(theirs)
    (a,) = torch.autograd.grad(dense.expand(ours), features, upstream)
    (b,) = torch.autograd.grad(theirs, features, upstream)
    torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_the_first_of_equal_maxima_takes_the_gradient() -> None:
    x = OctreeBatch.full(torch.zeros(1, 1, 16, 16, 16))
    features = x.features.clone().requires_grad_()
    grid_pool(x.with_features(features)).features.sum().backward()
    assert features.grad.view(-1, 8)[:, 0].all() and not features.grad.view(-1, 8)[:, 1:].any()


@few
@given(data=st.data())
def test_unpool_is_nearest_neighbour_and_doubles_widths(data, batches, dense) -> None:
    x = data.draw(batches())
    up = grid_unpool(x)
    assert torch.equal(dense.expand(up), upsample(dense.expand(x)))
    wide = np.minimum(2 * dense.widths(x.structure), 8).repeat(2, 1).repeat(2, 2).repeat(2, 3)
    np.testing.assert_array_equal(dense.widths(up.structure), wide)


@few
@given(data=st.data())
def test_unpooling_onto_what_was_pooled(data, batches, dense) -> None:
    x = data.draw(batches(even=True))
    pooled = grid_pool(x, "mean")
    up = grid_unpool(pooled, guide=x)
    assert up.structure is x.structure
    assert torch.equal(dense.expand(up), upsample(dense.expand(pooled)))


@few
@given(data=st.data())
def test_concat_takes_means_over_the_leaves_of_the_first(data, batches, make_batch, dense) -> None:
    a = data.draw(batches())
    b = make_batch(data.draw(st.integers(0, 99)), a.structure.grid, a.batch_size, 2,
                   data.draw(st.sampled_from([0.0, 0.5, 1.0])))
    features = b.features.clone().requires_grad_()
    both = concat(a, b.with_features(features))
    assert both.structure is a.structure
    assert torch.equal(both.features[:, : a.channels], a.features)
    theirs = dense.leaf_average(a.structure, dense.expand(b.with_features(features)))
    ours = both.features[:, a.channels :]
    torch.testing.assert_close(ours, theirs, rtol=1e-13, atol=1e-13)
    upstream = torch.randn_like(theirs)
    torch.testing.assert_close(torch.autograd.grad(ours, features, upstream),
                               torch.autograd.grad(theirs, features, upstream), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("operation", [
    lambda x: grid_pool(x, "max"),
    lambda x: grid_pool(x, "mean"),
    grid_unpool,
    lambda x: grid_unpool(grid_pool(x, "mean"), guide=x),
    lambda x: concat(x, x),
])
def test_gradcheck(operation, make_batch) -> None:
    x = make_batch(1, (2, 2, 2), batch_size=2, channels=2, likelihood=0.6)
    assert torch.autograd.gradcheck(lambda f: operation(x.with_features(f)).features,
                                    x.features.requires_grad_(), fast_mode=True)


def test_equal_structures_concatenate_without_a_copy_of_the_structure(make_batch) -> None:
    a = make_batch(0)
    twin = OctreeBatch(type(a.structure)(a.structure.trees.copy()), a.features)
    assert torch.equal(concat(a, twin).features, torch.cat([a.features, a.features], 1))


@pytest.mark.parametrize(("call", "message"), [
    (lambda make: grid_pool(make(0, (1, 2, 2))), "even number of trees.*multiples of 16"),
    (lambda make: grid_pool(make(0, (2, 2, 2)), "median"), "found median, expected max or mean"),
    (lambda make: concat(make(0), make(0, (1, 1, 2))), "differ in size"),
    (lambda make: concat(make(0), make(0, dtype=torch.float32)), "dtype or device"),
    (lambda make: grid_unpool(make(0, likelihood=1.0), guide=make(0, (2, 2, 2), likelihood=0.0)), "coarser"),
    (lambda make: grid_unpool(make(0), guide=make(0, (1, 1, 2))), "sizes do not fit"),
])
def test_what_does_not_fit_is_refused(call, message, make_batch) -> None:
    with pytest.raises(OcnfError, match=message):
        call(make_batch)


def test_a_guide_of_another_size_is_refused(make_batch) -> None:
    x = make_batch(0, (2, 2, 2))
    for guide in (x, x.structure, make_batch(0, (4, 4, 2)), "x"):
        with pytest.raises(OcnfError, match="guide: sizes do not fit"):
            grid_unpool(x, guide=guide)
