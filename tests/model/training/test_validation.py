"""What an epoch's validation measures, shows and chooses by."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ocnf_data import ShardDataset
from ocnf_data.encodings import Encoding
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_model.checkpoint import open_run
from ocnf_model.measures.figures import f_score
from ocnf_model.measures.surface import Surface
from ocnf_model.network import Output
from ocnf_model.training.batches import make_example
from ocnf_model.training.choice import BestBy, is_better
from ocnf_model.training.pictures import draw_slices
from ocnf_model.training.run import train
from ocnf_model.training.train_state import EpochRow, load_state
from ocnf_model.training.validation import Validator

ROW = EpochRow(level=1, epoch=1, resolution=32, steps=1, train_loss=0.1, val_mad=2.0, val_iou=0.5,
               seconds=1.0, best=True, val_f_score=0.4)


@pytest.fixture(scope="module")
def run(tiny, small, tmp_path_factory) -> Path:
    """Three epochs of one level."""
    folder = tmp_path_factory.mktemp("measured") / "run"
    stages = [{"epochs": 3, "batch_size": 2, "accumulate": 1, "learning_rate": 2e-2, "decay": "cosine"}]
    train(tiny, folder, small(levels=1, stages=stages), device="cpu")
    return folder


def test_tensorboard_has_rates_times_regions_and_a_picture(run) -> None:
    events = EventAccumulator(str(run / "tensorboard" / "level1"))
    events.Reload()
    rates = [event.value for event in events.Scalars("level1/learning_rate")]
    assert len(rates) == 9 and rates[0] == pytest.approx(2e-2) and sorted(rates, reverse=True) == rates
    times = events.Scalars("level1/step_seconds")
    assert len(times) == 6 and all(event.value > 0 for event in times)  # none for the first of an epoch
    mads = [event.value for event in events.Scalars("level1/val_mad")]
    regions = [[event.value for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]
               if "val_mad_by_region/" in tag]
    assert len(regions) == 6
    np.testing.assert_allclose(np.sum(regions, axis=0), mads, rtol=1e-5)
    pictures = events.Images("level1/input, reconstruction, truth")
    assert len(pictures) == 3 and pictures[0].width > 3 * 128 and pictures[0].height > 2 * 128
    assert len(events.Scalars("level1/val_f_score")) == 3


def test_the_curves_and_the_checkpoint_have_the_surface(run) -> None:
    rows = load_state(run)[0].rows
    with (run / "curves.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [float(line["val_f_score"]) for line in lines] == [row.val_f_score for row in rows]
    best = min(rows, key=lambda row: row.val_mad * (1 - row.val_f_score))
    header = open_run(run).headers[0]
    assert header.epoch == best.epoch and header.metrics["f_score"] == best.val_f_score
    assert [row.epoch for row in rows if row.best][-1] == best.epoch


def test_a_validation_is_of_the_definition(tiny) -> None:
    batch = next(iter(ShardDataset(tiny, "val", [32], "tsdf", batch_size=2, uneven="exact", shuffle=False)))
    example = make_example(batch, Output.TSDF, "tsdf", torch.device("cpu"))
    prediction = example.inputs[0]
    validator = Validator(Output.TSDF, Encoding.TSDF, tau=0.2)
    validator.add(prediction, example)
    found = validator.means(lambda sums: sums)
    expected = (prediction.to_dense() - example.target.to_dense()).abs().mean() * 200
    assert found.mad == pytest.approx(float(expected), rel=1e-5)
    assert found.regions.total == pytest.approx(found.mad, rel=1e-9)
    unseen = prediction.to_dense() <= -1
    part = (prediction.to_dense() - example.target.to_dense()).abs()[unseen].sum() / unseen.numel() * 200
    assert found.regions.unseen_free + found.regions.unseen_band + found.regions.unseen_inside \
        == pytest.approx(float(part), rel=1e-5)
    scores = [f_score(Surface.of_octree(a, 32.0), Surface.of_octree(b, 32.0), 1.0)
              for a, b in zip(prediction.to_grids(), example.target.to_grids(), strict=True)]
    assert found.f_score == pytest.approx(np.mean(scores)) and 0.1 < found.f_score < 1
    assert found.picture.shape[2] == 3
    nothing = Validator(Output.TSDF, Encoding.TSDF, 0.2)
    assert nothing.means(lambda sums: sums) is None


def test_the_f_score_is_that_of_dense_points_of_both_surfaces(tiny) -> None:
    """Against brute force: the middles of marching cubes' faces, by area, to corners, sides and middles."""
    sample = next(iter(ShardDataset(tiny, "val", [64], "tsdf")))
    found, true = sample.inputs[64].grids()[0], sample.targets[64].grids()[0]
    rng = np.random.default_rng(0)

    def within(ones: np.ndarray, others: np.ndarray) -> float:
        areas = np.linalg.norm(np.cross(ones[:, 1] - ones[:, 0], ones[:, 2] - ones[:, 0]), axis=1)
        points = ones[rng.choice(len(ones), 800, p=areas / areas.sum())].mean(axis=1)
        sides = (others + np.roll(others, 1, axis=1)) / 2
        there = np.concatenate([others.reshape(-1, 3), sides.reshape(-1, 3), others.mean(axis=1)])
        return np.mean([(((there - point) ** 2).sum(axis=1) <= 1).any() for point in points])

    a, b = (vertices[faces] for vertices, faces in (octree_surface(found, 64.0), octree_surface(true, 64.0)))
    precision, recall = within(a, b), within(b, a)
    expected = 2 * precision * recall / (precision + recall)
    measured = f_score(Surface.of_octree(found, 64.0), Surface.of_octree(true, 64.0), 1.0)
    assert measured == pytest.approx(expected, abs=0.04)


def test_occupancy_has_a_surface_and_no_regions(tiny) -> None:
    batch = next(iter(ShardDataset(tiny, "val", [32], "tsdf")))
    example = make_example(batch, Output.OCCUPANCY, "tsdf", torch.device("cpu"))
    validator = Validator(Output.OCCUPANCY, Encoding.TSDF, 0.2)
    validator.add(example.target, example)
    found = validator.means(lambda sums: sums)
    assert (found.mad, found.iou, found.f_score) == (0, 1, 1) and math.isnan(found.regions.total)


@pytest.mark.parametrize(("by", "better", "worse"), [
    ("mad", {"val_mad": 1.9, "val_f_score": 0.1}, {"val_mad": 2.1, "val_f_score": 0.9}),
    ("iou", {"val_iou": 0.6, "val_mad": 9.0}, {"val_iou": 0.4, "val_mad": 1.0}),
    ("f_score", {"val_f_score": 0.5, "val_mad": 9.0}, {"val_f_score": 0.3, "val_mad": 1.0}),
    ("mad_and_f_score", {"val_mad": 2.2, "val_f_score": 0.5}, {"val_mad": 1.9, "val_f_score": 0.3}),
])
def test_the_best_epoch_is_the_best_by_the_measure_of_the_settings(by, better, worse) -> None:
    measure = BestBy(by)
    assert is_better(ROW, None, measure)
    assert is_better(replace(ROW, **better), ROW, measure)
    assert not is_better(replace(ROW, **worse), ROW, measure)
    assert not is_better(ROW, ROW, measure)


def test_an_epoch_whose_surface_was_not_measured_is_compared_by_mad() -> None:
    old = replace(ROW, val_f_score=None)
    assert is_better(replace(ROW, val_mad=1.9, val_f_score=0.0), old, BestBy.F_SCORE)
    assert not is_better(replace(ROW, val_mad=2.1, val_f_score=1.0), old, BestBy.F_SCORE)


def test_slices_stand_side_by_side_in_the_colours_of_what_they_hold() -> None:
    half = np.ones((1, 32, 32, 32), np.float32)
    half[:, :16] = -1  # the lower half is inside
    octree = GridOctree.from_dense(half)
    picture = draw_slices([(octree, octree, GridOctree.from_dense(-half))] * 2, Encoding.TSDF)
    assert picture.shape == (2 * 128 + 4, 3 * 128 + 2 * 4, 3) and picture.dtype == np.uint8
    free, inside = picture[10, 10].tolist(), picture[120, 10].tolist()
    assert free == [141, 185, 221] and inside == [181, 72, 58]
    assert picture[10, -10].tolist() == inside and picture[120, -10].tolist() == free
