"""`SynthesisDataset`: samples equal to generated ones, a pure function of (seed, epoch, number)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from ocnf_data import MixtureDataset, SynthesisDataset
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.generation.plan import list_items, make_plan
from ocnf_data.generation.sample import make_sample
from ocnf_data.octree.codec import decode_raw
from ocnf_data.shards.tarformat import input_member, target_member
from ocnf_data.synthesis.draw import Body, Look
from ocnf_data.synthesis.sample import make_inputs, make_truths, pose
from ocnf_data.synthesis.sources import open_sources
from ocnf_data.views.noise import NoiseModel
from ocnf_data.views.rigs import rig_from_name


def open_set(manifest: Any, **arguments: Any) -> SynthesisDataset:
    return SynthesisDataset(manifest, **{"resolutions": [16, 32], "encoding": "histogram", "batch_size": 3,
                                         "rank": 0, "world_size": 1, **arguments})


def contents(batch: Any) -> tuple[Any, ...]:
    return (batch.epoch, batch.step, batch.keys, batch.repeat, batch.slots, batch.meta,
            batch.arena.numpy().tobytes())


def test_with_a_generated_sample_s_pose_views_and_noise_it_is_that_sample_bit_for_bit(small):
    manifest = small({"metres": 0.5}, inputs=[
        {"name": "v4", "views": 4, "sigma": 0.02, "encodings": list(Encoding)},
        {"name": "v1", "views": 1, "encodings": ["histogram"]},
        {"name": "k3", "views": 3, "noise": "kinect", "strength": 0.7, "metres": 0.5, "encodings": ["tsdf"]}])
    for item in make_plan(manifest, None).items[:4]:
        generated = make_sample(manifest, item).members
        posed = pose(manifest, Body(item), None)
        pairs = [(target_member(resolution), octree)
                 for resolution, octree in make_truths(manifest, posed, manifest.resolutions).items()]
        for variant in manifest.inputs:
            views = manifest.view_indices(variant)
            look = Look(rig_from_name(manifest.camera.rig)[list(views)], views, NoiseModel(variant.noise),
                        manifest.seed, item.key, variant.sigma, variant.strength)
            for encoding in variant.encodings:
                made = make_inputs(manifest, posed, look, encoding, manifest.resolutions)
                pairs += [(input_member(variant.name, encoding, resolution), octree)
                          for resolution, octree in made.items()]
        assert {name for name, _ in pairs} == set(generated) - {"json"}
        for name, octree in pairs:
            stored = decode_raw(generated[name])
            np.testing.assert_array_equal(octree.trees, stored.trees)
            np.testing.assert_array_equal(octree.data, stored.data)
            assert octree.data.dtype == stored.data.dtype


def test_a_sample_depends_on_seed_epoch_and_number_alone(small):
    manifest = small({"rotate": "any", "directions": {"rig": 1, "random": 1, "sphere": 1}})
    one = [contents(batch) for batch in open_set(manifest)]
    again = open_set(manifest)
    assert [contents(batch) for batch in again] == one
    assert [contents(batch)[2:] for batch in again] != [c[2:] for c in one]  # epoch 1
    assert [contents(batch)[2:] for batch in open_set(manifest, seed=1)] != [c[2:] for c in one]
    # whatever the batches and ranks are, sample i is the same one
    single = {batch.keys[0]: batch for batch in open_set(manifest, batch_size=1)}
    assert len(single) == 10
    for rank in range(2):
        for batch in open_set(manifest, batch_size=2, rank=rank, world_size=2):
            for key, octrees, truth in zip(batch.keys, batch.inputs[32].grids(), batch.targets[32].grids(),
                                           strict=True):
                np.testing.assert_array_equal(octrees.data, single[key].inputs[32].grids()[0].data)
                np.testing.assert_array_equal(truth.trees, single[key].targets[32].grids()[0].trees)


def test_the_ground_truth_may_be_left_out_where_only_the_input_is_read(small, monkeypatch):
    made = []

    def make(manifest, posed, resolutions):
        made.append(resolutions)
        return make_truths(manifest, posed, resolutions)

    monkeypatch.setattr("ocnf_data.synthesis.supply.make_truths", make)
    whole, some = (next(iter(open_set(small(), resolutions=[16, 32], targets=targets)))
                   for targets in (True, [16]))
    assert list(some.inputs) == list(whole.targets) == [16, 32] and list(some.targets) == [16]
    assert torch.equal(some.targets[16].data, whole.targets[16].data)
    assert torch.equal(some.inputs[32].data, whole.inputs[32].data)
    assert set(made) == {(16, 32), (16,)}  # and is not made


def test_every_sample_of_an_epoch_is_met_once_and_the_tail_is_marked(small):
    batches = list(open_set(small(), batch_size=4))
    numbers = [key.rsplit("-", 1)[1] for batch in batches for key in batch.keys]
    assert numbers == [str(i % 10) for i in range(12)]
    assert [again for batch in batches for again in batch.repeat] == [False] * 10 + [True] * 2
    assert len(list(open_set(small(), batch_size=4, drop_last=True))) == 2


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_change_nothing_and_a_state_resumes_with_another_number_of_them(small, workers):
    manifest = small({"rotate": "upright"})
    whole = open_set(manifest)
    wanted = [contents(batch) for _ in range(2) for batch in whole]
    dataset = open_set(manifest)
    loader = DataLoader(dataset, batch_size=None, num_workers=workers, persistent_workers=True)
    met = []
    for batch in loader:
        met.append(contents(batch))
        if batch.step == 1:
            state = dataset.state_dict(batch)
            break
    resumed = open_set(manifest)
    resumed.load_state_dict(state)
    other = DataLoader(resumed, batch_size=None, num_workers=3 - workers)
    met += [contents(batch) for batch in other]
    met += [contents(batch) for batch in other]
    assert met == wanted
    assert torch.utils.data.get_worker_info() is None


def test_a_split_that_is_none_is_named(small):
    scenes = {"kind": "scenes", "categories": ["rooms"], "counts": {"train": 1}}
    for manifest in (small(), small(source=scenes)):
        with pytest.raises(OcnfError, match="split: no split of a manifest; found tran, expected train, val"):
            SynthesisDataset(manifest, 16, "tsdf", split="tran")
    with pytest.raises(OcnfError, match="opened for another split; found train, expected val"):
        SynthesisDataset(open_sources(small(), None, "val"), 16, "tsdf")


def test_a_mixture_s_state_tells_the_seed_of_a_part(small):
    def of(seed: int) -> MixtureDataset:
        inner = MixtureDataset([(open_set(small(), seed=seed), 1)], 6, rank=0, world_size=1)
        return MixtureDataset([(inner, 1)], 6, rank=0, world_size=1)

    state = of(0).state_dict()
    of(0).load_state_dict(state)
    with pytest.raises(OcnfError, match="parts: the state is of a run with another order"):
        of(1).load_state_dict(state)


def test_parts_of_shapes_may_share_a_category(small):
    parts = [{"weight": 3, "source": {"kind": "shapes", "categories": ["chair"], "counts": {"train": 1}}},
             {"weight": 1, "source": {"kind": "shapes", "categories": ["chair", "table"],
                                      "counts": {"train": 1}}}]
    manifest = small(source={"kind": "mixture", "parts": parts})
    categories = [pool.categories for pool in open_sources(manifest, None, "train").pools]
    assert categories == [("chair",), ("chair", "table")]
    assert all(len(batch.keys) for batch in open_set(manifest))
    with pytest.raises(OcnfError, match=r"source.parts: two items have the same key.*in one part alone"):
        list_items(manifest, None)
