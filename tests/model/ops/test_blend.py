"""The blend with plain fusion: what it takes from each encoding, and that it is between its two parts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data import Views, fuse_histogram, fuse_tdf_occupancy, fuse_tsdf
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_model import OctNetFusion
from ocnf_model.ops.blend import FusionBlend, plain_tsdf

few = settings(max_examples=20, deadline=None)


@pytest.fixture(scope="module")
def views() -> Views:
    """Three cameras before a wavy wall, not square, off centre, with pixels that measured nothing."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:40, :56]
    waves = 2 + 0.2 * np.sin(columns / 7) * np.cos(rows / 5)
    depth = np.stack([waves + 0.05 * rng.standard_normal(waves.shape) for _ in range(3)])
    depth[rng.random(depth.shape) < 0.1] = 0
    K = np.array([[40.0, 0, 25], [0, 42, 22], [0, 0, 1]])
    T = np.array([[0.1 * i, 0, 2] for i in range(3)])
    return Views(depth.astype(np.float32), np.stack([K] * 3), np.stack([np.eye(3)] * 3), T)


@pytest.mark.parametrize("make", [fuse_tsdf, fuse_tdf_occupancy])
def test_of_tsdf_it_is_plain_fusion(make, views) -> None:
    encoding = Encoding.TSDF if make is fuse_tsdf else Encoding.TDF_OCCUPANCY
    octree = make(views, 32, truncation=0.2)
    values = plain_tsdf(torch.from_numpy(octree.data), encoding)[:, 0].numpy()
    truth = fuse_tsdf(views, 32, truncation=0.2).to_dense()[0]
    np.testing.assert_allclose(octree.with_data(values[:, None]).to_dense()[0], truth, atol=1e-6)
    assert (np.abs(truth) < 0.9).sum() > 300


def test_of_a_histogram_it_is_plain_fusion_to_what_the_bins_hide(views) -> None:
    """A vote in (0.875, 1.125) tau is off by 1/16 tau at most (at 0.9375 and at tau); others by nothing."""
    octree = fuse_histogram(views, 32, truncation=0.2)
    values = plain_tsdf(torch.from_numpy(octree.data), Encoding.HISTOGRAM).numpy()
    found, truth = octree.with_data(values).to_dense()[0], fuse_tsdf(views, 32, truncation=0.2).to_dense()[0]
    votes = octree.to_dense()
    hidden = (votes[9] > 0) & (votes[9] < 1)
    np.testing.assert_allclose(found[~hidden], truth[~hidden], atol=1e-5)
    assert np.abs(found - truth).max() <= 1 / 16 + 1e-5
    assert (np.abs(truth[~hidden]) < 0.9).sum() > 300


@few
@given(seed=st.integers(0, 99), before=st.integers(0, 3), behind=st.integers(0, 2),
       encoding=st.sampled_from([Encoding.TSDF, Encoding.TDF_OCCUPANCY, Encoding.HISTOGRAM]))
def test_it_lies_between_its_parts_by_the_gate(seed, before, behind, encoding) -> None:
    generator = torch.Generator().manual_seed(seed)
    encoded = torch.rand(50, encoding.channels, generator=generator, dtype=torch.float64)
    if encoding is Encoding.HISTOGRAM:
        encoded = encoded / encoded.sum(1, keepdim=True)
    around = [torch.rand(50, n, generator=generator, dtype=torch.float64) for n in (before, behind)]
    own, features = (torch.randn(50, n, generator=generator, dtype=torch.float64) for n in (1, 4))
    own = own.tanh()
    blend = FusionBlend(encoding, before, 4).double()
    inputs = torch.cat([around[0], encoded, around[1]], 1)
    plain = plain_tsdf(encoded, encoding)
    torch.testing.assert_close(blend(own, features, inputs), 0.95 * own + 0.05 * plain, rtol=1e-6, atol=1e-6)
    blend.begin_at(0.8)
    torch.testing.assert_close(blend(own, features, inputs), 0.2 * own + 0.8 * plain, rtol=1e-6, atol=1e-6)
    torch.nn.init.normal_(blend.gate.weight, generator=generator)
    share = torch.sigmoid(16 * (features @ blend.gate.weight[0] + blend.gate.bias))[:, None]
    torch.testing.assert_close(blend(own, features, inputs), share * plain + (1 - share) * own)
    assert torch.autograd.gradcheck(lambda a, b: blend(a, b, inputs[:5]),
                                    (own[:5].requires_grad_(), features[:5].requires_grad_()))


def test_the_own_part_is_cut_off_and_comes_back() -> None:
    """Beyond 1.25 it counts as that, and only what leads back into the range is a gradient."""
    blend = FusionBlend(Encoding.TSDF, 0, 1)
    blend.begin_at(0.25)
    own = torch.tensor([[3.0], [-3.0], [1.5], [-1.5], [1.2]], requires_grad=True)
    found = blend(own, torch.zeros(5, 1), torch.zeros(5, 1))
    torch.testing.assert_close(found, torch.tensor([[0.9375], [-0.9375], [0.9375], [-0.9375], [0.9]]))
    (gradient,) = torch.autograd.grad(found, own, torch.tensor([[1.0], [1.0], [-1.0], [-1.0], [-1.0]]))
    torch.testing.assert_close(gradient, torch.tensor([[0.75], [0.0], [0.0], [-0.75], [-0.75]]))


def test_in_half_precision_plain_fusion_stays_whole() -> None:
    blend = FusionBlend(Encoding.TSDF, 0, 2)
    torch.nn.init.constant_(blend.gate.bias, 50.0)
    plain = torch.linspace(-1, 1, 1001)[:, None]
    with torch.autocast("cpu", torch.bfloat16):
        found = blend(torch.zeros(1001, 1).bfloat16(), torch.zeros(1001, 2).bfloat16(), plain)
    assert torch.equal(found, plain)


@pytest.mark.parametrize("settings", [{"encoding": "occupancy"}, {"encoding": "tsdf", "output": "occupancy"}])
def test_what_has_no_tsdf_cannot_be_blended(settings) -> None:
    with pytest.raises(OcnfError, match="blend"):
        OctNetFusion(levels=1, blend=True, **settings)
