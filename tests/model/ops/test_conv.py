"""Convolution equals the dense one, averaged over the leaves; its gradients are those of that definition."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import conv3d

from ocnf_data.errors import OcnfError
from ocnf_model import OctreeBatch, OctreeConv3d
from ocnf_model.octree.neighbours import Neighbours
from ocnf_model.octree.structure import Structure
from ocnf_model.ops import chunks, octree_conv
from ocnf_model.ops.chunks import near_rows


def reference(dense, x: OctreeBatch, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    return dense.leaf_average(x.structure, conv3d(dense.expand(x), weight, bias, padding=1))


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_conv_and_its_gradients_equal_the_dense_definition(data, batches, dense) -> None:
    x = data.draw(batches())
    torch.manual_seed(data.draw(st.integers(0, 99)))
    features = x.features.clone().requires_grad_()
    weight = torch.randn(2, x.channels, 3, 3, 3).double().requires_grad_()
    bias = torch.randn(2).double().requires_grad_()
    ours = octree_conv(x.with_features(features), weight, bias).features
    theirs = reference(dense, x.with_features(features), weight, bias)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    upstream = torch.randn_like(ours)
    torch.testing.assert_close(torch.autograd.grad(ours, (features, weight, bias), upstream),
                               torch.autograd.grad(theirs, (features, weight, bias), upstream),
                               rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("likelihood", [0.0, 0.3, 0.7])
def test_gradcheck(likelihood, make_batch) -> None:
    x = make_batch(3, (1, 2, 1), batch_size=2, channels=2, likelihood=likelihood)
    conv = OctreeConv3d(2, 3).double()
    inputs = (x.features.requires_grad_(), conv.weight, torch.randn(3).double().requires_grad_())
    assert torch.autograd.gradcheck(lambda f, w, b: octree_conv(x.with_features(f), w, b).features, inputs,
                                    fast_mode=True)


def test_chunks_do_not_show(make_batch, dense, monkeypatch) -> None:
    x = make_batch(4, (2, 2, 2), channels=3, likelihood=0.8)
    conv = OctreeConv3d(3, 2).double()
    whole = conv(x).features
    monkeypatch.setattr("ocnf_model.ops.chunks._CPU_ELEMENTS", 27 * 3 * 50)
    torch.testing.assert_close(conv(x).features, whole, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(whole, reference(dense, x, conv.weight, conv.bias), rtol=1e-12, atol=1e-12)


def test_the_gather_of_a_gpu_is_that_of_the_cpu(make_batch, monkeypatch) -> None:
    """PyTorch's operations, which a GPU runs, in place of the compiled copy of octets."""
    from ocnf_model.ops import chunks

    x = make_batch(10, (2, 1, 3), batch_size=2, channels=3, likelihood=0.8)
    conv = OctreeConv3d(3, 2).double()
    compiled = conv(x).features
    monkeypatch.setattr(chunks, "_copy_by_kernel", chunks._copy)
    assert torch.equal(conv(x).features, compiled)


def test_threads_share_the_work_and_repeat_themselves(make_batch, monkeypatch) -> None:
    monkeypatch.setattr("ocnf_model.ops.chunks._CPU_ELEMENTS", 27 * 3 * 20)
    x = make_batch(9, (2, 2, 2), channels=3, likelihood=0.8, dtype=torch.float32)
    conv = OctreeConv3d(3, 3)
    before = torch.get_num_threads()
    results = []
    try:
        for n_threads in (1, 3, 3):
            torch.set_num_threads(n_threads)
            features = x.features.clone().requires_grad_()
            y = conv(x.with_features(features)).features
            results.append((y, *torch.autograd.grad(y.square().sum(), (features, conv.weight))))
            assert torch.get_num_threads() == n_threads
    finally:
        torch.set_num_threads(before)
    one, three, again = results
    torch.testing.assert_close(one, three, rtol=1e-5, atol=1e-4)
    assert all(torch.equal(a, b) for a, b in zip(three, again, strict=True))


def test_only_the_gradients_asked_for(make_batch) -> None:
    x = make_batch(5, (1, 1, 2))
    conv = OctreeConv3d(2, 2).double()
    conv(x).features.sum().backward()
    assert x.features.grad is None
    conv.weight.requires_grad_(False)
    moving = x.with_features(x.features.requires_grad_())
    conv(moving).features.sum().backward()
    assert x.features.grad is not None


def test_tables_are_made_once_for_all_layers_on_a_structure(make_batch, monkeypatch) -> None:
    calls = []
    build = Neighbours.build
    counting = lambda structure: (calls.append(structure), build(structure))[1]  # noqa: E731
    monkeypatch.setattr(Neighbours, "build", counting)
    x = make_batch(6)
    OctreeConv3d(2, 2).double()(OctreeConv3d(2, 2).double()(x)).features.sum().backward()
    assert len(calls) == 1


def test_float32_takes_another_kernel_and_agrees(make_batch) -> None:
    """float32 on a CPU is multiplied by oneDNN, float64 is not: forward, both gradients, all to rounding."""
    x = make_batch(8, (2, 2, 2), channels=5, likelihood=0.7)
    torch.manual_seed(0)
    conv = OctreeConv3d(5, 7).double()
    results = []
    for dtype in (torch.float64, torch.float32):
        conv = conv.to(dtype)
        features = x.features.to(dtype).requires_grad_()
        y = conv(x.with_features(features)).features
        results.append((y, *torch.autograd.grad(y.square().mean(), (features, conv.weight, conv.bias))))
    for exact, rounded in zip(*results, strict=True):
        assert (rounded - exact).norm() < 2e-6 * exact.norm()


def test_without_bias_and_in_low_precision(make_batch) -> None:
    x = make_batch(7, (2, 2, 2), channels=4, likelihood=0.8, dtype=torch.float32)
    conv = OctreeConv3d(4, 8, bias=False)
    exact = conv(x).features
    moving = x.with_features(x.features.requires_grad_())
    with torch.autocast("cpu", torch.bfloat16):
        rough = conv(moving).features
    assert rough.dtype == torch.bfloat16
    torch.testing.assert_close(rough.float(), exact, rtol=0.05, atol=0.1)
    rough.float().square().sum().backward()
    assert conv.weight.grad is not None and conv.weight.grad.dtype == torch.float32
    (expected,) = torch.autograd.grad(conv(moving).features.square().sum(), conv.weight)
    assert (conv.weight.grad - expected).norm() < 0.02 * expected.norm()


@pytest.mark.parametrize("likelihood", [0.0, 0.7])
def test_gradients_of_wide_leaves_fit_into_float16(likelihood: float, make_batch) -> None:
    """A leaf of 512 voxels times a feature of 200 is beyond 65,504; the gradient is not."""
    x = make_batch(9, (2, 2, 2), channels=2, likelihood=likelihood)
    found = []
    for dtype in (torch.float64, torch.float16):
        conv = OctreeConv3d(2, 2).to(dtype)
        y = conv(x.with_features((x.features.abs() + 200).to(dtype))).features
        found.append(torch.autograd.grad((y * 1e-3).sum(), conv.weight)[0].double())
    assert (found[1] - found[0]).norm() < 0.01 * found[0].norm()


def test_he_initialisation() -> None:
    torch.manual_seed(0)
    conv = OctreeConv3d(32, 64)
    assert conv.weight.std().item() == pytest.approx((2 / (27 * 32)) ** 0.5, rel=0.02)
    assert not conv.bias.any()


@pytest.mark.parametrize(("channels", "dtype", "message"), [
    (3, torch.float32, "found 3, expected 2 for a weight"),
    (2, torch.float64, "found torch.float64 on cpu, expected torch.float32"),
])
def test_what_does_not_fit_is_refused(channels, dtype, message, make_batch) -> None:
    with pytest.raises(OcnfError, match=message):
        OctreeConv3d(2, 4)(make_batch(0, channels=channels, dtype=dtype))
    with pytest.raises(OcnfError, match="out_channels"):
        OctreeConv3d(2, 0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("channels", [1, 3, 16, 26])
def test_means_around_twos_are_those_of_pytorch_to_the_bit(channels: int, dtype: torch.dtype) -> None:
    """Both add along x, y, z; bfloat16 is rounded as PyTorch rounds, ties, what is not finite and all."""
    torch.manual_seed(channels)
    features = torch.randn(500, channels).mul(2.0 ** torch.randint(-3, 4, (500, 1))).to(dtype)
    features[::50] = torch.tensor([0.0, 1.0, -1.0, 2.0**-130, torch.inf] * 2).to(dtype)[:, None]
    twos = torch.randint(0, 501, (40, 64), dtype=torch.int32)  # 500 is outside the grid
    twos[0] = 500
    made = [torch.full((40, 27 * channels), torch.nan, dtype=dtype) for _ in range(2)]
    for out, average in zip(made, (chunks._average, chunks._average_by_kernel), strict=True):
        average(twos, features, out)
    assert not made[0][0].any()
    torch.testing.assert_close(made[1], made[0], rtol=0, atol=0, equal_nan=True)


def test_wide_leaves_read_near_ones_alone(make_batch) -> None:
    """`near` is what the entries name, once each and in order; a grid of voxels has no wide leaf at all."""
    x = make_batch(9, (3, 2, 2), channels=3, likelihood=0.5)
    tables = Neighbours.build(x.structure)
    assert torch.equal(tables.columns.unique().long(), torch.arange(len(tables.near)))
    assert torch.equal(tables.near, tables.near.unique())
    assert len(tables.near) < x.structure.n_leaves
    far = torch.ones(x.structure.n_leaves, dtype=torch.bool)
    far[tables.near] = False
    conv = OctreeConv3d(3, 4).double()
    moved = x.features.clone()
    moved[far] += 1
    wide = tables.wide
    before, after = (conv(x.with_features(features)).features[wide] for features in (x.features, moved))
    assert torch.equal(before, after)
    moved[tables.near[::7]] += 1
    assert not torch.equal(before, conv(x.with_features(moved)).features[wide])
    full = Structure.full(1, (8, 8, 16))
    assert len(Neighbours.build(full).near) == 0
    assert torch.equal(near_rows(Neighbours.build(full), torch.ones(full.n_leaves, 2)), torch.ones(0, 2))


def test_features_whose_rows_are_columns_have_gradients() -> None:
    torch.manual_seed(0)
    conv = OctreeConv3d(10, 4)
    gradients = []
    for values in (torch.rand(512, 10), None):
        leaf = (gradients[0][0].t().contiguous().t() if values is None else values).requires_grad_()
        x = OctreeBatch.full(torch.zeros(1, 10, 8, 8, 8)).with_features(leaf)
        conv(x).features.square().sum().backward()
        gradients.append((leaf.detach(), leaf.grad))
    assert not gradients[1][0].is_contiguous()
    torch.testing.assert_close(gradients[1][1], gradients[0][1])
