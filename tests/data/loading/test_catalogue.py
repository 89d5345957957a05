"""Data sets with and without a catalogue are read alike; with one, opening takes two requests."""

from __future__ import annotations

import logging
import pickle
import shutil
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from torch.utils.data import DataLoader

from ocnf_data import OcnfError, ShardDataset
from ocnf_data.encodings import Encoding
from ocnf_data.files.storage import Store
from ocnf_data.loading import places
from ocnf_data.loading.catalogue import Request, open_catalogue
from ocnf_data.loading.fetch import Fetcher
from ocnf_data.shards import load_dataset
from ocnf_data.shards.index import ShardIndex, catalogue_path, index_path
from ocnf_data.verify.repair import restore_catalogues
from ocnf_data.verify.verify import verify

BENCH = Path(__file__).parents[3] / "tools" / "bench"
SIZES = {"train": [3, 1, 4, 1, 2], "test": [2, 1, 1]}


@pytest.fixture
def simulation(monkeypatch):
    """`tools/bench/catalogue.py`: simulated data sets, and a server that counts requests."""
    monkeypatch.syspath_prepend(str(BENCH))
    import catalogue

    yield catalogue
    del sys.modules["catalogue"]


def seen(batches):
    return [(batch.keys, batch.categories, batch.repeat, batch.arena.tolist()) for batch in batches]


@pytest.mark.parametrize("options", [{}, {"categories": ["lamp"]}, {"categories": ["chair"], "seed": 3},
                                     {"shuffle": False}, {"split": "test"}])
def test_a_data_set_without_a_catalogue_gives_the_same_batches(eleven, sets, tmp_path, options):
    old = sets.write(tmp_path / "old", SIZES, catalogues=False)
    assert not load_dataset(old).files
    settings = {"split": "train", "resolutions": [16, 32], "encoding": "histogram", "batch_size": 2} | options
    then, now = ShardDataset(old, **settings), ShardDataset(eleven, **settings)
    assert then.keys == now.keys
    assert seen(then) == seen(now)
    now.load_state_dict(then.state_dict())  # and it is the same data set


def test_a_category_picks_what_the_json_members_say(eleven):
    for split in ("train", "test"):
        everything = list(ShardDataset(eleven, split, 16, "histogram", shuffle=False, uneven="exact"))
        for category in ("chair", "lamp"):
            chosen = ShardDataset(eleven, split, 16, "histogram", categories=[category], shuffle=False)
            assert chosen.keys == tuple(batch.keys[0] for batch in everything
                                        if batch.meta[0]["category"] == category)
            assert all(batch.categories == (category,) for batch in chosen)


def test_a_lost_catalogue_is_told_of_and_the_indices_are_read(eleven, tmp_path, caplog):
    shutil.copytree(eleven, tmp_path / "set")
    (tmp_path / "set" / catalogue_path("train")).unlink()
    with caplog.at_level(logging.WARNING):
        dataset = ShardDataset(tmp_path / "set", "train", 16, "histogram")
    assert "5 indices are read instead" in caplog.text
    assert seen(dataset) == seen(ShardDataset(eleven, "train", 16, "histogram"))
    assert [(row.file, row.code) for row in verify(str(tmp_path / "set")).problems] == [
        (catalogue_path("train"), "missing")]
    assert restore_catalogues(str(tmp_path / "set")) == [catalogue_path("train")]
    assert verify(str(tmp_path / "set")).ok


def test_samples_of_several_kinds_lack_what_they_lack(sets, tmp_path):
    """Members differ between data sets, and the first sample that lacks one is named."""
    both = [sets.write(tmp_path / "a", {"train": [2]}, prefix="a"),
            sets.write(tmp_path / "b", {"train": [1, 2]}, {"v4": ["tsdf"]}, prefix="b")]
    for url in both:
        ShardDataset(url, "train", 16, None)
    with pytest.raises(OcnfError, match=r"b/train/shard-000000\.tar: b000: variant: .*found v4-histogram-16"):
        ShardDataset(both, "train", 16, "histogram")


def test_places_are_kept_for_as_many_members_as_are_allowed(eleven, monkeypatch):
    """Each index is read once, or again where there is no room to keep it; the samples are the same."""
    request = Request("train", (16, 32), Encoding.HISTOGRAM, "v4", categories=None, targets=(16, 32))
    read = []
    load = places.load_index

    def counting(store, split, entry):
        read.append(entry.shard)
        return load(store, split, entry)

    monkeypatch.setattr(places, "load_index", counting)
    order = [0, 10, 4, 1, 9, 5, 0, 10]
    fetcher = Fetcher(open_catalogue([eleven], request))
    first = [fetcher.fetch(sample).key for sample in order]
    assert first == [f"s{sample:03d}" for sample in order]
    assert len(read) == len(set(read)) == 3
    read.clear()
    monkeypatch.setattr(places, "_KEPT_MEMBERS", 12)  # five members a sample
    fetcher = Fetcher(open_catalogue([eleven], request))
    assert [fetcher.fetch(sample).key for sample in order] == first
    assert len(read) > 3


def test_a_hundred_thousand_samples_open_with_two_requests_and_in_little_memory(simulation, tmp_path):
    """6,250 shards over a network, and no index is read until a sample is asked for."""
    simulation.simulate(tmp_path, 100_000, catalogue=True, indices=False)
    grids = simulation.RESOLUTIONS
    request = Request("train", grids, Encoding.HISTOGRAM, None, None, targets=grids)
    with simulation.slow_server(tmp_path, latency=0.0) as server:
        assert len(open_catalogue([server.url], request)) == 100_000
        assert server.requests == 2
    tracemalloc.start()
    try:
        catalogue = open_catalogue([str(tmp_path)], request)
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak / 100_000 < 400
    assert held / 100_000 < 100
    assert len(pickle.dumps(catalogue)) / 100_000 < 60  # what a spawned worker is sent
    for sample in (0, 15, 16, 77_777, 99_999):
        category = simulation.CATEGORIES[sample % 4]
        assert catalogue.keys[sample] == f"{category}-train-{sample:07d}"
        assert catalogue.category(sample) == category
        assert divmod(sample, 16) == (catalogue.shard_of[sample], catalogue.position[sample])
        assert catalogue.closes(sample) == (sample % 16 == 15)
    assert catalogue.shards.entry(4861) == load_dataset(str(tmp_path)).splits["train"][4861]


def test_the_members_of_a_sample_are_those_of_its_index(simulation, tmp_path):
    """Over a network: one request for an index, when its first sample is needed."""
    simulation.simulate(tmp_path, 50, catalogue=False, indices=True)
    restore_catalogues(str(tmp_path))
    request = Request("train", (256,), Encoding.HISTOGRAM, None, categories=("bed", "chair"), targets=(256,))
    with simulation.slow_server(tmp_path, latency=0.0) as server:
        finder = places.PlaceFinder(catalogue := open_catalogue([server.url], request))
        before = server.requests
        for sample in range(len(catalogue)):
            shard, position = int(catalogue.shard_of[sample]), catalogue.position[sample]
            blob = (tmp_path / index_path("train", f"shard-{shard:06d}.tar")).read_bytes()
            entry = ShardIndex.from_json(blob, "index").samples[position]
            assert entry.key == catalogue.keys[sample]
            assert entry.category in ("bed", "chair")
            assert finder.members(sample) == [entry.member(name) for name in catalogue.request.members()]
        assert server.requests - before == 4
    assert len(catalogue) == 25


def test_workers_read_over_a_network_what_one_process_reads_from_a_folder(eleven, simulation):
    with simulation.slow_server(Path(eleven), latency=0.001) as server:
        dataset = ShardDataset(server.url, "train", [16, 32], "histogram", batch_size=3)
        remote = list(DataLoader(dataset, batch_size=None, num_workers=2))
    assert seen(remote) == seen(ShardDataset(eleven, "train", [16, 32], "histogram", batch_size=3))
    assert np.concatenate([batch.arena for batch in remote]).any()
    assert Store(server.url).is_local is False
