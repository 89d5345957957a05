"""A small data set on disk, and ways to damage it."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ocnf_data.files.storage import Store
from ocnf_data.octree import GridOctree
from ocnf_data.octree.codec import encode
from ocnf_data.shards import Counts, DatasetInfo, FileEntry, ShardEntry, ShardWriter, write_dataset

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
    """Make a finished data set out of {"train": [[(key, members), ...], ...]} and return its store."""

    def write(shards: dict[str, list[list[tuple[str, Members]]]], root: Path | str | None = None) -> Store:
        store = Store(root or tmp_path / "set")
        splits: dict[str, tuple[ShardEntry, ...]] = {}
        for split, lists in shards.items():
            for number, samples in enumerate(lists):
                with ShardWriter(store, split, number) as writer:
                    for key, members in samples:
                        writer.add(key, members, timings={"render": 0.25})
                splits[split] = (*splits.get(split, ()), writer.entry)
        failures = b'{"code":"empty","item":"chair_bad","message":"no faces","stage":"read"}\n'
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
    sizes = [{"target-64.oct": 512, "v4_n02-tsdf-64.oct": 511}, {"target-64.oct": 513}, {"target-64.oct": 1}]
    samples = [(f"chair_{i:04d}", opaque_sample(f"chair_{i:04d}", size)) for i, size in enumerate(sizes)]
    other = [("lamp-7", opaque_sample("lamp-7", {"target-64.oct": 700}))]
    return write_set({"train": [samples, []], "test": [other]})


def octree_sample(key: str, seed: int, resolutions: tuple[int, ...] = (16, 32)) -> Members:
    """A ball off the centre as ground truth, and noise on coarse blocks as a histogram."""
    rng = np.random.default_rng(seed)
    members: Members = {}
    leaf_counts: dict[str, int] = {}
    centre, radius = rng.uniform(0.3, 0.7, 3), rng.uniform(0.15, 0.25)
    for resolution in resolutions:
        z, y, x = np.meshgrid(*[(np.arange(resolution) + 0.5) / resolution] * 3, indexing="ij")
        distance = np.sqrt((z - centre[0]) ** 2 + (y - centre[1]) ** 2 + (x - centre[2]) ** 2) - radius
        sdf = np.clip(distance * resolution / 2.13, -1, 1).astype(np.float32)
        bins = rng.integers(0, 10, (resolution // 8,) * 3).repeat(8, 0).repeat(8, 1).repeat(8, 2)
        histogram = np.moveaxis(np.eye(10, dtype=np.float32)[bins], -1, 0)
        for name, kind, values in ((f"target-{resolution}.oct", "target", sdf[None]),
                                   (f"v4_n02-histogram-{resolution}.oct", "histogram", histogram)):
            octree = GridOctree.from_dense(np.ascontiguousarray(values))
            members[name] = encode(octree, kind)
            leaf_counts[name] = octree.n_leaves
    return {"json": describe_sample(key, leaf_counts), **members}


@pytest.fixture(scope="session")
def octree_samples() -> list[tuple[str, Members]]:
    """Four samples with real octrees at 16 and 32 voxels along each axis."""
    return [(f"chair_{i:04d}", octree_sample(f"chair_{i:04d}", i)) for i in range(4)]


@pytest.fixture
def octree_set(write_set: Callable[..., Store], octree_samples: list[tuple[str, Members]]) -> Store:
    """Two training shards and a test shard of real octrees."""
    return write_set({"train": [octree_samples[:2], octree_samples[2:3]], "test": [octree_samples[3:]]})
