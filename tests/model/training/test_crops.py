"""Training on boxes: what lies deep inside one comes out as in the whole grid, and has the same loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model import OctNetFusion
from ocnf_model.losses import l1_loss
from ocnf_model.octree.crop import crop
from ocnf_model.training.batches import Example
from ocnf_model.training.crops import ALIGNMENT, MARGIN, crop_losses, draw_corners
from ocnf_model.training.run import train

SMALL = {"encoding": "tsdf", "channels": (2, 3, 4)}


def sparse_batch(make_batch, grid, batch_size=1, seed=0):
    """Mostly whole trees, so that a receptive field does not span the grid."""
    return make_batch(seed, (grid,) * 3, batch_size, 1, 0.9, torch.float64)


def test_voxels_whose_receptive_field_lies_in_the_box_are_those_of_the_whole_grid(make_batch, dense) -> None:
    """What depends on the outside is found by making the outside NaN, which nothing forgets."""
    torch.manual_seed(0)
    level = OctNetFusion(**SMALL, levels=1).double().levels[0]
    x = make_batch(0, (16, 8, 8), 1, 1, 0.97, torch.float64)
    corner, shape = np.array([[4, 0, 0]]), (12, 8, 8)
    inside = torch.full_like(x.features, float("nan"))
    kept = crop(x.with_features(torch.arange(len(x.features))[:, None].double()), corner, shape)
    rows = kept.features[:, 0].long()
    inside[rows] = x.features[rows]
    with torch.no_grad():
        whole = level(x).raw
        told = crop(level(x.with_features(inside)).raw, corner, shape).features
        box = level(crop(x, corner, shape)).raw.features
    independent = told.isfinite()
    assert 0.3 < independent.double().mean() < 1
    expected = crop(whole, corner, shape).features
    torch.testing.assert_close(box[independent], expected[independent])
    assert not torch.allclose(box[~independent], expected[~independent])


def test_a_box_that_is_the_grid_has_the_grids_loss(make_batch) -> None:
    torch.manual_seed(1)
    network = OctNetFusion(**SMALL, levels=2).double()
    inputs = [sparse_batch(make_batch, 4 << level, 2, level) for level in range(2)]
    target = sparse_batch(make_batch, 8, 2, 9)
    losses = crop_losses(network, Example(inputs, target), 1, np.zeros((1, 2, 3), np.int64), 8, l1_loss)
    expected = l1_loss(network.run(inputs)[-1].raw, target, "none")
    torch.testing.assert_close(losses, expected)
    losses.sum().backward()
    assert all(p.grad is None for p in network.levels[0].parameters())
    assert all(p.grad is not None for p in network.levels[1].parameters())


def test_a_box_reads_what_is_finer(make_batch) -> None:
    torch.manual_seed(1)
    network = OctNetFusion(**SMALL, levels=3, finer=2).double()
    inputs = [sparse_batch(make_batch, 4 << level, 2, level) for level in range(3)]
    example = Example(inputs, sparse_batch(make_batch, 8, 2, 9))
    assert example.encoded is inputs[1]
    losses = crop_losses(network, example, 1, np.zeros((1, 2, 3), np.int64), 8, l1_loss)
    expected = l1_loss(network.run(inputs, levels=2)[-1].raw, example.target, "none")
    torch.testing.assert_close(losses, expected)
    assert len(network.run(inputs)) == 3


def test_the_outer_voxels_of_a_box_have_no_loss_but_at_the_grids_faces(make_batch) -> None:
    torch.manual_seed(2)
    network = OctNetFusion(**SMALL, levels=1).double()
    x, target = (make_batch(seed, (8, 8, 16), 1, 1, 0.3, torch.float64) for seed in (0, 1))
    corner = np.array([[0, 0, 8]])
    (found,) = crop_losses(network, Example([x], target), 0, corner[None], 8, l1_loss)
    box = network.levels[0](crop(x, corner, (8, 8, 8))).raw
    low = np.array([[0, 0, MARGIN]])
    expected = l1_loss(crop(box, low, (8, 8, 8 - MARGIN)), crop(target, corner + low, (8, 8, 8 - MARGIN)))
    torch.testing.assert_close(found, expected)


def test_several_boxes_count_alike(make_batch) -> None:
    torch.manual_seed(2)
    network = OctNetFusion(**SMALL, levels=1).double()
    x, target = (make_batch(seed, (8, 8, 16), 2, 1, 0.3, torch.float64) for seed in (0, 1))
    corners = np.array([[[0, 0, 8], [0, 0, 0]], [[0, 0, 4], [0, 0, 8]], [[0, 0, 0], [0, 0, 0]]])
    example = Example([x], target)
    alone = [crop_losses(network, example, 0, corner[None], 8, l1_loss) for corner in corners]
    together = crop_losses(network, example, 0, corners, 8, l1_loss)
    torch.testing.assert_close(together, (alone[0] + alone[1] + alone[2]) / 3)
    assert len({*together.tolist(), *alone[0].tolist(), *alone[1].tolist()}) == 6


def test_weights_are_cut_out_of_the_same_place(make_batch) -> None:
    """A box's loss with the weights of the whole grid is that of the voxels that have a weight."""
    torch.manual_seed(2)
    network = OctNetFusion(**SMALL, levels=1).double()
    x, target = (make_batch(seed, (8, 8, 16), 1, 1, 0.3, torch.float64) for seed in (0, 1))
    weights = x.with_features(torch.rand(len(x.features), 1, dtype=torch.float64))
    corner, low, shape = np.array([[0, 0, 8]]), np.array([[0, 0, MARGIN]]), (8, 8, 8 - MARGIN)
    (found,) = crop_losses(network, Example([x], target), 0, corner[None], 8, l1_loss, weights)
    box = network.levels[0](crop(x, corner, (8, 8, 8))).raw
    expected = l1_loss(crop(box, low, shape), crop(target, corner + low, shape),
                       weights=crop(crop(weights, corner, (8, 8, 8)), low, shape))
    torch.testing.assert_close(found, expected)


def test_corners_are_aligned_within_the_grid_and_a_pure_function(make_batch) -> None:
    truth = make_batch(3, (8, 12, 16), 3, 1, 0.02).structure
    keys = ["a", "b", "c"]
    drawn = np.concatenate([draw_corners(truth, 8, 0, epoch, keys) for epoch in range(40)])
    assert (drawn % ALIGNMENT == 0).all() and (drawn >= 0).all()
    assert (drawn + 8 <= truth.grid).all()
    np.testing.assert_array_equal(drawn[7:8], draw_corners(truth, 8, 0, 7, keys))
    np.testing.assert_array_equal(drawn[7:8, 1:2], draw_corners(
        type(truth)(truth.trees[1:2]), 8, 0, 7, keys[1:2]))
    several = draw_corners(truth, 8, 0, 7, keys, 20)
    np.testing.assert_array_equal(several[:1], drawn[7:8])
    assert len({tuple(corner) for corner in several[:, 0].tolist()}) > 1
    assert len({tuple(corner) for corner in drawn[:, 0].tolist()}) > 1
    # The one divided tree of a grid lies in every box.
    trees = np.zeros((1, 16, 16, 16, 2), np.uint64)
    trees[0, 13, 2, 7, 0] = 1
    for epoch in range(10):
        ((corner,),) = draw_corners(type(truth)(trees), 8, 1, epoch, ["x"])
        assert (corner <= (13, 2, 7)).all() and (corner + 8 > (13, 2, 7)).all()
    with pytest.raises(OcnfError, match="larger than the grid"):
        draw_corners(truth, 16, 0, 0, keys)


def test_a_run_trains_on_crops(tiny, small, out) -> None:
    stages = [{"epochs": 1, "batch_size": 2, "accumulate": 1},
              {"epochs": 2, "batch_size": 2, "accumulate": 1, "crop": 64, "crops": 2}]
    network = train(tiny, out, small(stages=stages))
    assert len(network.levels) == 2 and (out / "level-2.safetensors").is_file()
    with pytest.raises(OcnfError, match="larger than the grid"):
        train(tiny, out.with_name("other"), small(stages=[stages[0], {**stages[1], "crop": 96}]))
    with pytest.raises(OcnfError, match="context needs the whole grid"):
        small(context=16, stages=[stages[1]])
    with pytest.raises(OcnfError, match="the whole grid is one box"):
        small(stages=[{**stages[0], "crops": 2}])
