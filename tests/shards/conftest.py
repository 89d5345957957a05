"""A small data set on disk, and ways to damage it."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from ocnf_data.shards import Counts, DatasetInfo, FileEntry, ShardEntry, ShardWriter, write_dataset
from ocnf_data.storage import Store

Members = dict[str, bytes]


def describe_sample(key: str, leaf_counts: dict[str, int], category: str = "chair") -> bytes:
    """A `json` member with what the index needs, and something more."""
    facts = {"key": key, "category": category, "source": f"{category}/{key}.off", "leaf_counts": leaf_counts,
             "seed": 0}
    return json.dumps(facts).encode()


def opaque_sample(key: str, sizes: dict[str, int]) -> Members:
    """Members of the given sizes whose octrees are noise: for what does not decode them."""
    noise = random.Random(key)
    return {"json": describe_sample(key, dict.fromkeys(sizes, 9)),
            **{name: noise.randbytes(size) for name, size in sizes.items()}}


@pytest.fixture
def sample_json() -> Callable[..., bytes]:
    return describe_sample


@pytest.fixture
def opaque() -> Callable[[str, dict[str, int]], Members]:
    return opaque_sample


@pytest.fixture
def write_set(tmp_path: Path) -> Callable[..., Store]:
    """write_set({"train": [[(key, members), ...], ...]}) makes a finished data set and returns its store."""

    def write(shards: dict[str, list[list[tuple[str, Members]]]], root: Path | str | None = None) -> Store:
        store = Store(root or tmp_path / "set")
        splits: dict[str, tuple[ShardEntry, ...]] = {}
        for split, lists in shards.items():
            for number, samples in enumerate(lists):
                with ShardWriter(store, split, number) as writer:
                    for key, members in samples:
                        writer.add(key, members, timings={"render": 0.25})
                splits[split] = (*splits.get(split, ()), writer.entry)
        failures = (b'{"category":"chair","code":"empty","item":"chair_bad","message":"no faces","source":"x.off",'
                    b'"split":"train","stage":"read"}\n')
        store.put_bytes("failures.jsonl", failures)
        samples_in_all = sum(entry.samples for entries in splits.values() for entry in entries)
        counts = Counts(items=samples_in_all + 1, samples=samples_in_all, failures=1, exclusions=0)
        write_dataset(store, DatasetInfo(name="tiny", manifest={"seed": 0}, fingerprint="f00d", counts=counts,
                                         splits=splits, files=(FileEntry.of("failures.jsonl", failures),)))
        return store

    return write


@pytest.fixture
def opaque_set(write_set: Callable[..., Store]) -> Store:
    """Two splits; 3 + 1 samples whose sizes sit on, before and after block borders; one empty shard."""
    sizes = [{"target-64.oct": 512, "v4_n02-histogram-64.oct": 511}, {"target-64.oct": 513}, {"target-64.oct": 1}]
    samples = [(f"chair_{i:04d}", opaque_sample(f"chair_{i:04d}", size)) for i, size in enumerate(sizes)]
    other = [("lamp-7", opaque_sample("lamp-7", {"target-64.oct": 700}))]
    return write_set({"train": [samples, []], "test": [other]})
