"""The dense context on octrees: a dense computation, then the mean over each leaf."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import avg_pool3d, interpolate

from ocnf_data.errors import OcnfError
from ocnf_model.ops import DenseContext


def noisy_context(channels: int) -> DenseContext:
    """One whose last layer is not zero."""
    torch.manual_seed(0)
    context = DenseContext(channels, 16).double()
    for parameter in context.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    return context


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 99), grid=st.sampled_from([(1, 1, 1), (1, 2, 3), (2, 1, 1)]),
       batch_size=st.integers(1, 3), likelihood=st.sampled_from([0.0, 0.4, 1.0]))
def test_it_adds_the_leaf_means_of_a_dense_computation(seed, grid, batch_size, likelihood, make_batch,
                                                       dense) -> None:
    x = make_batch(seed, grid, batch_size, 3, likelihood, torch.float64)
    context = noisy_context(3)
    volume = dense.expand(x)
    half = context.down1(avg_pool3d(volume, 2))
    quarter = interpolate(context.down2(avg_pool3d(half, 2)), scale_factor=2, mode="trilinear")
    added = interpolate(context.out(context.up(torch.cat([quarter, half], 1))), scale_factor=2,
                        mode="trilinear")
    expected = dense.leaf_average(x.structure, added) + x.features
    torch.testing.assert_close(context(x).features, expected, rtol=1e-5, atol=1e-5)


def test_a_new_one_changes_nothing_and_still_learns(make_batch) -> None:
    x = make_batch(1, (1, 1, 1), 2, 3, 0.5, torch.float64)
    context = DenseContext(3, 16).double()
    result = context(x)
    assert torch.equal(result.features, x.features)
    result.features.square().sum().backward()
    assert context.out.weight.grad is not None and context.out.weight.grad.any()


def test_every_leaf_hears_of_every_voxel(make_batch) -> None:
    """That is what it is for: the gradient of one leaf reaches the opposite corner of the volume."""
    x = make_batch(2, (2, 2, 2), 1, 3, 0.3, torch.float64)
    features = x.features.clone().requires_grad_()
    noisy_context(3)(x.with_features(features)).features[0].sum().backward()
    assert features.grad is not None and features.grad[-1].any()


def test_gradients(make_batch) -> None:
    x = make_batch(3, (1, 1, 1), 2, 2, 0.2, torch.float64)
    context = noisy_context(2)
    features = x.features.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda f: context(x.with_features(f)).features, features, atol=1e-4)


@pytest.mark.parametrize("width", [8, 24])
def test_a_width_that_cannot_be_grouped_is_refused(width) -> None:
    with pytest.raises(OcnfError, match="context") as caught:
        DenseContext(4, width)
    assert caught.value.found == width or str(width) in str(caught.value)
