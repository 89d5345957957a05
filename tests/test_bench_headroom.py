"""What the bench of headroom measures: mirror images are undone, and plain fusion gains nothing by them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from ocnf_data.encodings import Encoding
from ocnf_data.octree import GridOctree
from ocnf_model import OctNetFusion
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.ops.blend import plain_tsdf


@pytest.fixture(scope="module")
def bench(load_bench: Callable[[str], Any]) -> Any:
    return load_bench("headroom")


def votes(seed: int) -> OctreeBatch:
    """Histograms of a lopsided grid of 32 voxels a side, without two voxels alike in one octant."""
    rng = np.random.default_rng(seed)
    dense = np.zeros((10, 32, 32, 32), np.float32)
    dense[0] = 1
    dense[:, 3:19, 8:30, 1:9] = rng.dirichlet(np.ones(10), (16, 22, 8)).transpose(3, 0, 1, 2)
    return OctreeBatch.from_grids([GridOctree.from_dense(dense)])


def test_each_mirror_undoes_itself_and_the_first_moves_nothing(bench: Any) -> None:
    (grid,) = votes(0).to_grids()
    moved = [mirror(grid).to_dense() for mirror in bench.MIRRORS]
    assert len({one.tobytes() for one in moved}) == 8 and np.array_equal(moved[0], grid.to_dense())
    assert all(np.array_equal(mirror(mirror(grid)).to_dense(), grid.to_dense()) for mirror in bench.MIRRORS)


def test_a_network_that_is_plain_fusion_gains_nothing_by_mirror_images(bench: Any) -> None:
    torch.manual_seed(0)
    network = OctNetFusion(levels=1, blend=True).eval()
    encoded = votes(1)
    own = bench.reconstruction(network, [encoded])
    network.levels[0].blend.begin_at(1 - 1e-9)
    once = bench.reconstruction(network, [encoded])
    eight = bench.by_mirrors(network, [encoded])
    expected = encoded.with_features(plain_tsdf(encoded.features, Encoding.HISTOGRAM)).to_dense()
    assert not torch.allclose(own.to_dense(), expected, atol=1e-2)  # it is the blend that makes it so
    for found in (once, eight):
        torch.testing.assert_close(found.to_dense(), expected, atol=1e-5, rtol=0)
