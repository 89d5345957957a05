"""OctreeBatch holds what GridOctree holds, and nothing that does not fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_model import OctreeBatch


def octree(seed: int, shape: tuple[int, int, int] = (8, 16, 24), channels: int = 2) -> GridOctree:
    values = np.random.default_rng(seed).integers(0, 2, (channels, *(n // 4 for n in shape)))
    return GridOctree.from_dense(values.repeat(4, 1).repeat(4, 2).repeat(4, 3).astype(np.float32))


def test_grids_go_in_and_come_out() -> None:
    grids = [octree(0), octree(1), octree(2)]
    batch = OctreeBatch.from_grids(grids)
    np.testing.assert_array_equal(batch.features.numpy(), np.concatenate([g.data for g in grids]))
    np.testing.assert_array_equal(batch.to_dense().numpy(), np.stack([g.to_dense() for g in grids]))
    for before, after in zip(grids, batch.to_grids(), strict=True):
        assert np.array_equal(before.trees, after.trees)
        np.testing.assert_array_equal(before.data, after.data)


@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_to_dense_is_the_expansion(data, batches, dense) -> None:
    batch = data.draw(batches())
    assert torch.equal(batch.to_dense(), dense.expand(batch))


def test_full_makes_every_voxel_a_leaf_and_loses_nothing() -> None:
    volume = torch.randn(2, 3, 8, 16, 24)
    batch = OctreeBatch.full(volume)
    assert batch.n_leaves == 2 * 8 * 16 * 24
    assert (batch.structure.sizes == 1).all()
    assert torch.equal(batch.to_dense(), volume)


def test_full_and_to_dense_are_differentiable(make_batch) -> None:
    batch = make_batch(0, (1, 1, 2), batch_size=2, channels=1)
    features = batch.features.requires_grad_()
    assert torch.autograd.gradcheck(lambda f: batch.with_features(f).to_dense(), features, fast_mode=True)
    volume = torch.randn(1, 1, 8, 8, 16, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: OctreeBatch.full(v).features, volume, fast_mode=True)


def test_sizes_leaves_and_union_match_the_grids(make_batch, dense) -> None:
    a, b = make_batch(1, (1, 2, 1), 2), make_batch(2, (1, 2, 1), 2, likelihood=0.8)
    assert a.structure.leaves_per_grid == [g.n_leaves for g in a.to_grids()]
    union = a.structure.union(b.structure)
    np.testing.assert_array_equal(dense.widths(union),
                                  np.minimum(dense.widths(a.structure), dense.widths(b.structure)))
    assert a.structure.union(a.structure) is a.structure
    assert union.union(b.structure) is union


@pytest.mark.parametrize(("make", "message"), [
    (lambda: OctreeBatch.from_grids([]), "a batch without octrees"),
    (lambda: OctreeBatch.from_grids([octree(0), octree(0, (8, 8, 8))]), r"grids\[1\]: .*differ in size"),
    (lambda: OctreeBatch.from_grids([octree(0), octree(0, channels=3)]), r"grids\[1\]: .*differ in channels"),
    (lambda: OctreeBatch.full(torch.zeros(1, 1, 8, 8, 12)), "not a batch of volumes"),
    (lambda: OctreeBatch.full(torch.zeros(1, 1, 8, 8, 8, dtype=torch.int32)), "not a batch of volumes"),
    (lambda: OctreeBatch.from_grids([octree(0)]).with_features(torch.zeros(3, 1)), "found 3 rows"),
    (lambda: OctreeBatch.from_grids([octree(0)]).with_features(torch.zeros(3)), "not features"),
    (lambda: OctreeBatch.from_grids([octree(0)]).with_features("no"), "found str"),  # type: ignore[arg-type]
])
def test_what_does_not_fit_is_refused(make, message) -> None:
    with pytest.raises(OcnfError, match=message):
        make()


def test_features_that_are_not_finite_make_no_grids(make_batch) -> None:
    batch = make_batch(0)
    with pytest.raises(OcnfError, match="not finite"):
        batch.with_features(torch.full_like(batch.features, torch.nan)).to_grids()
