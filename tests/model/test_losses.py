"""Losses and metrics equal those of the dense volumes, whatever the two structures are."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import binary_cross_entropy_with_logits

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_data.octree.occupied import occupied
from ocnf_model import OctreeBatch, split_surface
from ocnf_model.evaluation.measure import Field
from ocnf_model.losses import bce_loss, l1_loss, truncated_l1_loss
from ocnf_model.metrics import mad_mm, occupancy_mad, occupancy_overlap, tsdf_overlap
from ocnf_model.octree.leafmap import leaf_means
from ocnf_model.octree.structure import Structure

few = settings(max_examples=20, deadline=None)


@st.composite
def pairs(draw: st.DrawFn, batches, make_batch) -> tuple[OctreeBatch, OctreeBatch]:
    a = draw(batches(channels=1))
    likelihood = draw(st.sampled_from([0.0, 0.4, 1.0]))
    b = make_batch(draw(st.integers(0, 99)), a.structure.grid, a.batch_size, 1, likelihood)
    return a, b


@few
@given(data=st.data())
def test_losses_and_gradients_equal_the_dense_ones(data, batches, make_batch, dense) -> None:
    a, b = data.draw(pairs(batches, make_batch))
    b = b.with_features(b.features.sigmoid())
    features = a.features.clone().requires_grad_()
    a = a.with_features(features)
    p, g = dense.expand(a), dense.expand(b)
    for ours, theirs in [(l1_loss(a, b), (p - g).abs().mean()),
                         (bce_loss(a, b), binary_cross_entropy_with_logits(p, g))]:
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(torch.autograd.grad(ours, features),
                                   torch.autograd.grad(theirs, features, retain_graph=True),
                                   rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(l1_loss(a, b, "none"), (p - g).abs().mean(dim=(1, 2, 3, 4)))


@few
@given(data=st.data())
def test_beyond_the_truncation_the_right_side_costs_nothing(data, batches, make_batch, dense) -> None:
    a, b = data.draw(pairs(batches, make_batch))
    b = b.with_features((2 * b.features).clamp(-1, 1))
    features = (2 * a.features).requires_grad_()
    a = a.with_features(features)
    p, g = dense.expand(a), dense.expand(b)
    bounded = torch.where(g == 1, p.clamp(max=1), torch.where(g == -1, p.clamp(min=-1), p))
    ours, theirs = truncated_l1_loss(a, b), (bounded - g).abs().mean()
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(torch.autograd.grad(ours, features), torch.autograd.grad(theirs, features),
                               rtol=1e-10, atol=1e-12)


@few
@given(data=st.data())
@pytest.mark.parametrize("truncated", [False, True])
def test_a_wrong_side_of_the_surface_costs_its_weight(truncated, data, batches, make_batch, dense) -> None:
    a, b = data.draw(pairs(batches, make_batch))
    b = b.with_features((2 * b.features).clamp(-1, 1))
    features = (2 * a.features).requires_grad_()
    a = a.with_features(features)
    p, g = dense.expand(a), dense.expand(b)
    costs = (p - g).abs()
    if truncated:
        costs = torch.where((g == 1) & (p > 1) | (g == -1) & (p < -1), 0, costs)
    theirs = (costs * torch.where((p < 0) != (g < 0), 2.5, 1.0)).mean()
    ours = (truncated_l1_loss if truncated else l1_loss)(a, b, wrong_sign=2.5)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(torch.autograd.grad(ours, features), torch.autograd.grad(theirs, features),
                               rtol=1e-10, atol=1e-12)


@few
@given(data=st.data())
@pytest.mark.parametrize("loss", [l1_loss, truncated_l1_loss, bce_loss])
def test_weights_multiply_the_costs_of_voxels(loss, data, batches, make_batch, dense) -> None:
    """They stand on a structure coarser than both, and the mean is over voxels, not over weights."""
    a, b = data.draw(pairs(batches, make_batch))
    b = b.with_features(b.features.clamp(-1, 1).abs() if loss is bce_loss else b.features.clamp(-1, 1))
    trees = a.structure.trees & b.structure.trees
    structure = Structure(trees)  # what is split in both
    weights = OctreeBatch(structure, torch.rand(structure.n_leaves, 1, dtype=a.features.dtype))
    features = a.features.clone().requires_grad_()
    a = a.with_features(features)
    p, g, w = dense.expand(a), dense.expand(b), dense.expand(weights)
    if loss is bce_loss:
        costs = binary_cross_entropy_with_logits(p, g, reduction="none")
    else:
        costs = (p - g).abs()
        if loss is truncated_l1_loss:
            costs = torch.where((g == 1) & (p > 1) | (g == -1) & (p < -1), 0, costs)
    ours, theirs = loss(a, b, weights=weights), (w * costs).mean()
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(torch.autograd.grad(ours, features), torch.autograd.grad(theirs, features),
                               rtol=1e-10, atol=1e-12)


@few
@given(data=st.data())
def test_metrics_equal_the_dense_ones(data, batches, make_batch, dense) -> None:
    a, b = data.draw(pairs(batches, make_batch))
    p, g = dense.expand(a), dense.expand(b)
    clipped = (p.clamp(-1, 1) - g.clamp(-1, 1)).abs().mean(dim=(1, 2, 3, 4))
    torch.testing.assert_close(mad_mm(a, b, 0.025), 25 * clipped)
    for overlap, predicted, true in [(tsdf_overlap(a, b), p < 0, g < 0),
                                     (occupancy_overlap(a, b), (p >= 0.5) & (g >= 0), g >= 0.5)]:
        for found, part, whole in [(overlap.iou, predicted & true, predicted | true),
                                   (overlap.precision, predicted & true, predicted),
                                   (overlap.recall, predicted & true, true)]:
            n, m, either = (mask.sum(dim=(1, 2, 3, 4)).double() for mask in (part, whole, predicted | true))
            torch.testing.assert_close(found, torch.where(m > 0, n / m.clamp(min=1), (either == 0).double()))


@pytest.mark.parametrize(("predicted", "true", "figures"), [
    (1.0, -1.0, 0.0), (-1.0, 1.0, 0.0), (1.0, 1.0, 1.0), (-1.0, -1.0, 1.0)])
def test_nothing_is_right_only_where_there_is_nothing(make_batch, predicted, true, figures) -> None:
    """Neither a prediction without anything solid nor a truth without is hit by any voxel."""
    batch = make_batch(0, (1, 1, 1), 2, 1)
    p, g = (batch.with_features(torch.full_like(batch.features, value)) for value in (predicted, true))
    for overlap in (tsdf_overlap(p, g), occupancy_overlap(p.with_features((1 - p.features) / 2),
                                                          g.with_features((1 - g.features) / 2))):
        for found in (overlap.iou, overlap.precision, overlap.recall):
            assert found.tolist() == [figures] * 2


@few
@given(data=st.data())
def test_unknown_voxels_have_no_loss_and_are_not_measured(data, batches, make_batch, dense) -> None:
    """A negative occupancy is unknown: the figures are those of the other voxels."""
    a, b = data.draw(pairs(batches, make_batch))
    unknown = b.features < -0.3
    b = b.with_features(torch.where(unknown, -1.0, b.features.sigmoid()))
    features = a.features.clone().requires_grad_()
    p, g = dense.expand(a.with_features(features)), dense.expand(b)
    losses = bce_loss(a.with_features(features), b, "none")
    for i, (logits, truth) in enumerate(zip(p, g, strict=True)):
        known = truth >= 0
        theirs = binary_cross_entropy_with_logits(logits[known], truth[known]) if known.any() \
            else logits.sum() * 0
        torch.testing.assert_close(losses[i], theirs, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(torch.autograd.grad(losses[i], features, retain_graph=True),
                                   torch.autograd.grad(theirs, features, retain_graph=True),
                                   rtol=1e-10, atol=1e-12)
        if known.any():
            found = occupancy_mad(a, b)[i]
            torch.testing.assert_close(found, (logits[known].detach() - truth[known]).abs().mean())


def test_a_voxel_on_the_surface_is_free_everywhere() -> None:
    """Occupied is TSDF < 0: one rule for target, encodings, structure module and metrics (SEMANTICS 2)."""
    volume = torch.tensor([-1.0, -1e-3, 0.0, 1e-3]).repeat(2).expand(1, 1, 8, 8, 8).contiguous()
    inside = (volume < 0).float()
    tsdf, sharp = OctreeBatch.full(volume), OctreeBatch.full(1 - 2 * inside)
    assert np.array_equal(occupied(tsdf.to_grids()[0]).to_dense(), inside[0])
    assert torch.equal(Field(tsdf, is_occupancy=False).as_occupancy().to_dense(), inside)
    for found in (tsdf_overlap(tsdf, sharp), tsdf_overlap(sharp, tsdf)):
        assert (found.both, found.only_predicted, found.only_true) == (inside.sum(), 0, 0)
    for value, splits in [(-1e-3, True), (1e-3, False)]:
        volume[..., ::2], volume[..., 1::2] = 0, value
        surface = OctreeBatch.full(volume)
        assert (split_surface(surface, surface).n_leaves == 16 ** 3) == splits


def test_leaf_means_of_the_target_would_flatter_a_coarse_prediction(dense) -> None:
    """One leaf that says 0 where the truth is half -1 and half 1: the mean error is 1, not 0."""
    volume = torch.ones(1, 1, 8, 8, 8)
    volume[..., :4] = -1
    truth = OctreeBatch.full(volume)
    coarse = OctreeBatch.from_grids([truth.to_grids()[0].from_dense(volume[0].numpy(), tolerance=9.0)])
    assert coarse.n_leaves == 1 and coarse.features.item() == 0
    flattered = (coarse.features - leaf_means(truth.structure, coarse.structure)(truth.features)).abs().mean()
    assert flattered == 0
    assert l1_loss(coarse, truth) == 1 == (dense.expand(coarse) - volume).abs().mean()
    assert mad_mm(coarse, truth, 0.025) == 25


def test_the_loss_does_not_clip_and_the_metric_does(make_batch) -> None:
    truth = make_batch(0, channels=1)
    truth = truth.with_features(torch.ones_like(truth.features))
    beyond = truth.with_features(3 * truth.features)
    assert l1_loss(beyond, truth) == 2
    assert mad_mm(beyond, truth, 0.025) == 0


def test_low_precision_is_compared_in_float32(make_batch) -> None:
    x = make_batch(0, channels=1, dtype=torch.bfloat16)
    assert l1_loss(x, x.to(dtype=torch.float32)).dtype == torch.float32


def test_gradcheck(make_batch) -> None:
    a, b = make_batch(1, (1, 1, 2), 2, 1), make_batch(2, (1, 1, 2), 2, 1, likelihood=0.8)
    b = b.with_features(b.features.sigmoid())
    features = a.features.requires_grad_()
    for loss in (l1_loss, bce_loss):
        assert torch.autograd.gradcheck(lambda f, loss=loss: loss(a.with_features(f), b), features,
                                        fast_mode=True)


def test_what_does_not_fit_is_refused(make_batch) -> None:
    a = make_batch(0, channels=1)
    with pytest.raises(OcnfError, match="differ in size"):
        l1_loss(a, make_batch(0, (1, 1, 2), channels=1))
    with pytest.raises(OcnfError, match="differ in channels"):
        l1_loss(a, make_batch(0, channels=2))
    with pytest.raises(OcnfError, match="expected mean or none"):
        l1_loss(a, a, "sum")


def test_what_is_no_occupancy_is_refused(make_batch) -> None:
    a = make_batch(0, channels=1)
    ones = a.with_features(torch.ones_like(a.features))
    assert bce_loss(a, ones).isfinite()
    with pytest.raises(OcnfError, match=r"occupancy: not an occupancy; found 1\.5"):
        bce_loss(a, ones.with_features(1.5 * ones.features))


@pytest.mark.parametrize("loss", [l1_loss, truncated_l1_loss])
def test_there_is_one_weight_a_voxel(loss, make_batch) -> None:
    torch.manual_seed(0)
    prediction, weights = (make_batch(i, (1, 1, 1), 1, channels, 0.3, torch.float64)
                           for i, channels in enumerate((1, 10)))
    with pytest.raises(OcnfError, match="weights: not one weight a voxel; found 10 channels"):
        loss(prediction, prediction, weights=weights)
    coarse = OctreeBatch(Structure.full(1, (8, 8, 8)), torch.ones(512, 1).double())
    undivided = OctreeBatch.from_grids([GridOctree.from_dense(np.zeros((1, 8, 8, 8), np.float32))])
    undivided = undivided.to(dtype=torch.float64)
    with pytest.raises(OcnfError, match="weights: finer somewhere than prediction and target"):
        loss(undivided, undivided, weights=coarse)
    for wrong_sign in (-5, float("nan")):
        with pytest.raises(OcnfError, match="wrong_sign: not a weight"):
            loss(undivided, undivided, wrong_sign=wrong_sign)
