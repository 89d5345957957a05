"""What comes out of a DataLoader: which samples, in which order, with which octrees."""

from __future__ import annotations

import io
import json
import time
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from ocnf_data import OcnfError, ShardDataset
from ocnf_data.loading.cursor import Cursor
from ocnf_data.loading.order import Partition, Uneven, epoch_order
from ocnf_data.octree import decode

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create")
SIZES = [3, 1, 4, 1, 2]  # of the shards of `eleven`


def load(dataset, workers=0, **options):
    return DataLoader(dataset, batch_size=None, num_workers=workers, **options)


def expected_batches(epoch, batch_size, rank=0, world=1, seed=0, uneven=Uneven.REPEAT, buffer=1024):
    """(keys, repeat) of every batch, from the pure functions."""
    order = epoch_order(SIZES, seed, epoch, buffer)
    part = Partition(sum(SIZES), batch_size, rank, world, uneven)
    return [(tuple(f"s{order[place]:03d}" for place in places), tuple(again.tolist()))
            for places, again in map(part.places, range(part.n_batches))]


def seen(batches):
    return [(batch.keys, batch.repeat) for batch in batches]


@pytest.mark.parametrize("persistent", [False, True])
@pytest.mark.parametrize("workers", [0, 1, 2, 3])
def test_order_and_epochs_are_the_same_for_any_number_of_workers(eleven, workers, persistent):
    dataset = ShardDataset(eleven, "train", 16, "histogram", batch_size=2)
    loader = load(dataset, workers, persistent_workers=persistent and workers > 0)
    for epoch in range(3):
        torch.manual_seed(0)  # so that the workers of every epoch get equal seeds
        batches = list(loader)
        assert seen(batches) == expected_batches(epoch, 2)
        assert [(batch.epoch, batch.step) for batch in batches] == [(epoch, step) for step in range(6)]
        assert len(loader) == len(dataset) == len(batches)


def test_spawned_workers_do_as_forked_ones(eleven):
    dataset = ShardDataset(eleven, "train", 16, "histogram", batch_size=2)
    batches = list(load(dataset, 2, multiprocessing_context="spawn"))
    assert seen(batches) == expected_batches(0, 2)
    assert all(batch.arena.is_shared() for batch in batches)
    assert dataset.epoch == 1


@pytest.mark.parametrize("persistent", [False, True])
def test_set_epoch_and_abandoned_epochs_with_workers(eleven, persistent):
    dataset = ShardDataset(eleven, "train", 16, "histogram", batch_size=2)
    loader = load(dataset, 2, persistent_workers=persistent)
    next(iter(loader))  # epoch 0, given up after a batch
    assert dataset.epoch == 1
    assert seen(loader) == expected_batches(1, 2)
    dataset.set_epoch(7)
    assert seen(loader) == expected_batches(7, 2)
    assert seen(loader) == expected_batches(8, 2)


def test_a_slow_worker_does_not_take_the_epoch_of_another_iteration(eleven, monkeypatch):
    """An iteration is given up before its second worker has begun it."""
    claim = Cursor.claim

    def late(self, worker=0, identity=None):
        time.sleep(0.2 * worker)
        return claim(self, worker, identity)

    monkeypatch.setattr(Cursor, "claim", late)
    loader = load(ShardDataset(eleven, "train", 16, "histogram"), 2, persistent_workers=True)
    assert [batch.epoch for batch in loader] == [0] * 11
    iter(loader)
    assert [batch.epoch for batch in loader] == [2] * 11


def test_iterations_that_overlap_have_an_epoch_each(eleven):
    dataset = ShardDataset(eleven, "train", 16, "histogram", batch_size=2)
    loader = load(dataset, 2)
    both = list(zip(loader, loader, strict=True))
    epochs = {(first.epoch, second.epoch) for first, second in both}
    assert epochs in ({(0, 1)}, {(1, 0)})


@pytest.mark.parametrize(("options", "uneven"), [
    ({}, Uneven.REPEAT), ({"drop_last": True}, Uneven.DROP), ({"uneven": "exact"}, Uneven.EXACT)])
def test_ranks_share_an_epoch(eleven, options, uneven):
    met = []
    for rank in range(2):
        dataset = ShardDataset(eleven, "train", 16, "histogram", seed=3, batch_size=2, rank=rank,
                               world_size=2, buffer=4, **options)
        batches = list(load(dataset, rank))
        assert seen(batches) == expected_batches(0, 2, rank, 2, 3, uneven, buffer=4)
        assert len(batches) == len(dataset)
        met += [key for batch in batches
                for key, again in zip(batch.keys, batch.repeat, strict=True) if not again]
    assert sorted(met) == sorted(set(met))
    assert len(met) == (8 if uneven is Uneven.DROP else 11)


def test_without_shuffling_samples_come_as_they_lie(eleven):
    dataset = ShardDataset(eleven, "test", 16, "histogram", batch_size=3, shuffle=False, uneven="exact")
    assert [batch.keys for batch in dataset] == [("s011", "s012", "s013"), ("s014",)]


def test_more_workers_and_ranks_than_shards(eleven):
    keys = []
    for rank in range(4):
        dataset = ShardDataset(eleven, "test", 16, "histogram", rank=rank, world_size=4)
        keys += [key for batch in load(dataset, 3) for key in batch.keys]
    assert sorted(keys) == ["s011", "s012", "s013", "s014"]


@pytest.mark.parametrize("step", range(7))
def test_a_state_resumes_at_the_next_batch(eleven, step):
    dataset = ShardDataset(eleven, "train", 16, "histogram", batch_size=2, augment="all")
    run = [batch for _ in range(2) for batch in dataset]
    state = json.loads(json.dumps(dataset.state_dict(run[step])))
    again = ShardDataset(eleven, "train", 16, "histogram", batch_size=2, augment="all")
    again.load_state_dict(state)
    again.set_epoch(state["epoch"])  # as a training loop does, which counts its epochs
    rest = list(again)
    rest += list(again) if len(rest) + step + 1 < len(run) else []
    assert [(b.epoch, b.step, b.keys, b.symmetries) for b in rest] == \
        [(b.epoch, b.step, b.keys, b.symmetries) for b in run[step + 1 : step + 1 + len(rest)]]
    assert rest[0].step == (step + 1) % 6


@pytest.mark.parametrize(("before", "after"), [(2, 3), (3, 0), (0, 2)])
def test_a_state_ignores_what_was_prefetched_and_the_number_of_workers(eleven, before, after):
    dataset = ShardDataset(eleven, "train", 16, "histogram", batch_size=1)
    batches = iter(load(dataset, before))
    for _ in range(4):
        state = dataset.state_dict(next(batches))
    del batches
    resumed = ShardDataset(eleven, "train", 16, "histogram", batch_size=1)
    resumed.load_state_dict(state)
    loader = load(resumed, after)
    assert seen(loader) == expected_batches(0, 1)[4:]
    assert seen(loader) == expected_batches(1, 1)


@pytest.mark.parametrize(("field", "options"), [
    ("seed", {"seed": 1}), ("batch_size", {"batch_size": 3}), ("split", {"split": "test"}),
    ("resolutions", {"resolutions": [16, 32]}), ("encoding", {"encoding": None}), ("buffer", {"buffer": 2}),
    ("augment", {"augment": "flips"}), ("world_size", {"rank": 0, "world_size": 2}),
    ("uneven", {"drop_last": True}), ("categories", {"categories": ["chair"]}), ("datasets", {}),
    ("targets", {"targets": False}), ("shuffle", {"shuffle": False}),
])
def test_a_state_of_another_run_is_refused_by_field(eleven, sets, tmp_path, field, options):
    settings = {"urls": eleven, "split": "train", "resolutions": 16, "encoding": "histogram"}
    state = ShardDataset(**settings).state_dict()
    if field == "datasets":
        options = {"urls": sets.write(tmp_path, {"train": SIZES})}
    with pytest.raises(OcnfError) as caught:
        ShardDataset(**settings | options).load_state_dict(state)
    assert (caught.value.code, caught.value.field) == ("state", field)


def test_a_state_behind_the_end_is_refused(eleven):
    dataset = ShardDataset(eleven, "train", 16, "histogram", batch_size=2)
    with pytest.raises(OcnfError, match="step"):
        dataset.load_state_dict(dataset.state_dict() | {"step": 6})


def test_octrees_are_the_stored_ones(eleven, sets):
    dataset = ShardDataset(eleven, "train", [32, 16], "histogram", batch_size=3)
    for batch in load(dataset, 2):
        assert list(batch.inputs) == list(batch.targets) == [32, 16]
        for resolution in (16, 32):
            for role, octrees in (("v4-histogram", batch.inputs[resolution]),
                                  ("target", batch.targets[resolution])):
                grids = octrees.grids()
                for key, meta, grid in zip(batch.keys, batch.meta, grids, strict=True):
                    members = sets.members(key, int(key[1:]), meta["category"], {"v4": ["histogram"]})
                    stored = decode(members[f"{role}-{resolution}.oct"])
                    assert np.array_equal(grid.trees, stored.trees)
                    np.testing.assert_array_equal(grid.data, stored.data)
                assert octrees.n_leaves == tuple(grid.n_leaves for grid in grids)
                assert octrees.data.dtype == (torch.uint8 if role != "target" else torch.float16)
                values = np.concatenate([grid.data for grid in grids])
                np.testing.assert_array_equal(octrees.to_float().numpy(), values)


def test_batches_travel_in_one_piece_of_shared_memory(eleven):
    batch = next(iter(load(ShardDataset(eleven, "train", [16, 32], "histogram", batch_size=2), 1)))
    assert batch.arena.is_shared()
    for octrees in (*batch.inputs.values(), *batch.targets.values()):
        for tensor in (octrees.trees, octrees.data):
            assert tensor.is_shared() and tensor.is_contiguous()
            assert tensor.untyped_storage().data_ptr() == batch.arena.data_ptr()
    moved = batch.to("meta")
    assert moved.inputs[16].data.device.type == "meta" and moved.keys == batch.keys
    pipe = io.BytesIO()
    ForkingPickler(pipe).dump(batch)
    assert len(pipe.getvalue()) < 4000 < batch.arena.nbytes  # what the queue carries is a handle


def test_batching_twice_is_refused(eleven):
    with pytest.raises(OcnfError, match=r"batch_size: .* expected None"):
        next(iter(DataLoader(ShardDataset(eleven, "train", 16, "histogram"))))


def test_only_what_is_asked_for_is_read(sets, tmp_path):
    """Every member but the asked ones is broken in place; nobody notices."""
    url = sets.write(tmp_path, {"train": [2]}, inputs={"v4": ["histogram", "tsdf"], "v1": ["histogram"]})
    tar = tmp_path / "train" / "shard-000000.tar"
    content = bytearray(tar.read_bytes())
    index = json.loads((tmp_path / "train" / "shard-000000.json").read_text())
    kept = {"json", "v1-histogram-16.oct", "target-16.oct"}
    for sample in index["samples"]:
        for member in sample["members"]:
            if member["name"] not in kept:
                content[member["offset"]] ^= 1
    tar.write_bytes(content)
    dataset = ShardDataset(url, "train", 16, "histogram", variant="v1")
    assert sorted(batch.keys[0] for batch in dataset) == ["s000", "s001"]
    with pytest.raises(OcnfError, match=r"v4-histogram-16\.oct"):
        list(ShardDataset(url, "train", 16, "histogram", variant="v4"))


def test_variants_encodings_categories_and_targets(sets, tmp_path):
    url = sets.write(tmp_path, {"train": [2, 3]}, inputs={"v4": ["histogram", "tsdf"], "v1": ["histogram"]})
    assert ShardDataset(url, "train", 16, "tsdf").variant == "v4"
    with pytest.raises(OcnfError, match="several input variants"):
        ShardDataset(url, "train", 16, "histogram")
    lamps = ShardDataset(url, "train", 16, "histogram", "v1", categories=["lamp"])
    assert lamps.keys == ("s002",) and [b.categories for b in lamps] == [("lamp",)]
    inputs_only = next(iter(ShardDataset(url, "train", 16, "tsdf", targets=False)))
    assert list(inputs_only.inputs) == [16] and not inputs_only.targets
    some = next(iter(ShardDataset(url, "train", [16, 32], "tsdf", targets=[16])))
    both = next(iter(ShardDataset(url, "train", [16, 32], "tsdf")))
    assert list(some.inputs) == [16, 32] and list(some.targets) == [16] and some.keys == both.keys
    assert torch.equal(some.targets[16].data, both.targets[16].data)
    with pytest.raises(OcnfError, match="targets: no such resolution"):
        ShardDataset(url, "train", [16], "tsdf", targets=[32])
    targets_only = next(iter(ShardDataset(url, "train", [16, 32], None)))
    assert list(targets_only.targets) == [16, 32] and not targets_only.inputs


def test_several_data_sets_are_taken_as_one(sets, tmp_path):
    urls = [sets.write(tmp_path / name, {"train": [2, 1]}, prefix=name) for name in ("a", "b")]
    dataset = ShardDataset(urls, "train", 16, "histogram", batch_size=6)
    assert dataset.keys == ("a000", "a001", "a002", "b000", "b001", "b002")
    assert sorted(next(iter(dataset)).keys) == sorted(dataset.keys)
    other = sets.write(tmp_path / "c", {"train": [1]}, truncation_voxels=3.0)
    with pytest.raises(OcnfError, match="truncation_voxels"):
        ShardDataset([*urls, other], "train", 16, "histogram")


@pytest.mark.parametrize("augment", ["rotations", "flips", "all"])
def test_augmentation_is_exact_and_the_same_for_all_octrees_of_a_sample(eleven, augment):
    plain = {batch.keys[0]: batch for batch in ShardDataset(eleven, "train", [16, 32], "histogram")}
    dataset = ShardDataset(eleven, "train", [16, 32], "histogram", augment=augment)
    drawn = []
    for batch in [*dataset, *dataset]:
        before, move = plain[batch.keys[0]], batch.symmetries[0]
        drawn.append(move)
        for then, now in ((before.inputs, batch.inputs), (before.targets, batch.targets)):
            for resolution in (16, 32):
                dense = then[resolution].grids()[0].to_dense()
                expected = np.stack([np.flip(np.transpose(channel, move.axes), np.flatnonzero(move.flips))
                                     for channel in dense])
                np.testing.assert_array_equal(now[resolution].grids()[0].to_dense(), expected)
    assert len(set(drawn)) > 4 and drawn[:11] != drawn[11:]
    if augment == "rotations":
        assert all(move.is_rotation for move in drawn)
    if augment == "flips":
        assert {move.axes for move in drawn} == {(0, 1, 2)}
    workers = ShardDataset(eleven, "train", [16, 32], "histogram", augment=augment)
    assert [batch.symmetries[0] for batch in load(workers, 2)] == drawn[:11]


def test_ranks_come_from_the_environment(eleven, monkeypatch):
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "3")
    dataset = ShardDataset(eleven, "train", 16, "histogram")
    assert seen(dataset) == expected_batches(0, 1, rank=1, world=3)
    monkeypatch.setenv("RANK", "one")
    with pytest.raises(OcnfError, match="RANK"):
        ShardDataset(eleven, "train", 16, "histogram")


@pytest.mark.parametrize(("options", "words"), [
    ({"split": "dev"}, "split: .* found dev, expected test, train"),
    ({"resolutions": [16, 64]}, "resolutions: .* found 64, expected .*target-16"),
    ({"resolutions": []}, "resolutions"), ({"resolutions": [16, 16]}, "resolutions"),
    ({"resolutions": 12}, "resolutions"), ({"categories": []}, "categories"),
    ({"encoding": "colour"}, "encoding: .*'colour', expected occupancy"),
    ({"encoding": "tsdf"}, "encoding: .* found tsdf"),
    ({"encoding": None, "targets": False}, "nothing is asked for"),
    ({"variant": "v9"}, "variant: .* found v9-histogram-16"),
    ({"categories": ["sofa"]}, "categories: .* found sofa, expected chair, lamp"),
    ({"seed": -1}, "seed"), ({"seed": None}, "seed"), ({"batch_size": 0}, "batch_size"),
    ({"buffer": 0}, "buffer"), ({"rank": 1}, "world_size"), ({"rank": 2, "world_size": 2}, "rank"),
    ({"on_error": "ignore"}, "raise, skip"),
    ({"uneven": "even"}, "uneven"), ({"uneven": "exact", "drop_last": True}, "drop_last"),
    ({"batch_size": 12, "drop_last": True}, "drop_last leaves nothing"), ({"augment": "colour"}, "augment"),
    ({"max_bad_fraction": 2}, "max_bad_fraction"), ({"urls": []}, "urls"),
    ({"urls": "/nowhere"}, "no finished data set"),
])
def test_bad_settings_are_named(eleven, options, words):
    arguments = {"urls": eleven, "split": "train", "resolutions": 16, "encoding": "histogram"} | options
    with pytest.raises(OcnfError, match=words):
        ShardDataset(**arguments)


def test_a_batch_is_dense_tensors_if_asked(eleven, sets):
    dataset = ShardDataset(eleven, "train", [16, 32], "histogram", batch_size=3)
    batch = next(iter(dataset))
    for resolution in (16, 32):
        inputs, targets = batch.dense(resolution)
        assert (inputs.shape, inputs.dtype) == ((3, 10, *[resolution] * 3), torch.float32)
        assert (targets.shape, targets.dtype) == ((3, 1, *[resolution] * 3), torch.float32)
        for b, meta in enumerate(batch.meta):
            octree = sets.octree(meta["number"], resolution, "target")
            assert abs(targets[b].numpy() - octree.to_dense()).max() <= 1 / 2048
            expected = sets.octree(meta["number"], resolution, "histogram").to_dense()
            assert abs(inputs[b].numpy() - expected).max() <= 1 / 255
    with pytest.raises(OcnfError, match=r"no inputs of this resolution; found 64, expected \[16, 32\]"):
        batch.dense(64)
    bare = next(iter(ShardDataset(eleven, "train", 16, "histogram", targets=False)))
    with pytest.raises(OcnfError, match="no targets of this resolution; found 16, expected none"):
        bare.dense(16)


def test_a_number_of_processes_alone_would_make_each_the_first(eleven, monkeypatch):
    monkeypatch.delenv("RANK", raising=False)
    monkeypatch.setenv("WORLD_SIZE", "4")
    with pytest.raises(OcnfError, match="RANK: a number of processes without"):
        ShardDataset(eleven, "train", 16, "histogram")
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert len(ShardDataset(eleven, "train", 16, "histogram")) == 11


@pytest.mark.parametrize(("options", "said"), [
    ({"shuffle": "no"}, "shuffle: neither true nor false; found 'no'"),
    ({"drop_last": "False"}, "drop_last: neither true nor false"),
    ({"encoding": None, "variant": "typo"}, "variant: it would have no effect")])
def test_arguments_that_would_be_misread(eleven, options, said):
    with pytest.raises(OcnfError, match=said):
        ShardDataset(eleven, "train", **{"resolutions": 16, "encoding": "histogram", **options})
