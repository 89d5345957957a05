"""Tiny data sets, written with the shard writer, whose octrees can be recognised by their values."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from ocnf_data.files.storage import Store
from ocnf_data.octree import GridOctree, decode, encode
from ocnf_data.shards import Counts, DatasetInfo, ShardWriter, write_dataset
from ocnf_data.verify.repair import restore_catalogues

RESOLUTIONS = (16, 32)


def make_octree(number: int, resolution: int, kind: str) -> GridOctree:
    """An octree with leaves of every width, valid for its kind, other for each number."""
    rng = np.random.default_rng([number, resolution])
    field = np.ones((resolution,) * 3, np.float32)
    for width in (8, 4, 2, 1):
        z, y, x = width * rng.integers(0, resolution // width, 3)
        field[z : z + width, y : y + width, x : x + width] = rng.uniform(-1, 1)
    z, y, x = 8 * rng.integers(0, resolution // 8, 3)
    field[z : z + 8, y : y + 8, x : x + 8] = rng.uniform(-1, 1, (8, 8, 8))
    if kind in ("target", "tsdf"):
        values = field[None]
    elif kind == "histogram":
        share = (field + 1) / 2
        values = np.stack([share, 1 - share, *([np.zeros_like(share)] * 8)])
    else:
        values = np.stack([abs(field), np.float32(field < 0)])[: 2 if kind == "tdf_occupancy" else 1]
    return GridOctree.from_dense(values.astype(np.float32))


def make_members(key: str, number: int, category: str, inputs: dict[str, list[str]]) -> dict[str, bytes]:
    """The members of sample `number`; `inputs` is {variant: encodings}."""
    octrees = {f"target-{res}.oct": (make_octree(number, res, "target"), "target") for res in RESOLUTIONS}
    for variant, encodings in inputs.items():
        for encoding in encodings:
            for res in RESOLUTIONS:
                octrees[f"{variant}-{encoding}-{res}.oct"] = (make_octree(number, res, encoding), encoding)
    facts = {"key": key, "category": category, "source": f"shapes:{category}:{number}", "number": number,
             "leaf_counts": {name: octree.n_leaves for name, (octree, _) in octrees.items()}}
    return {"json": json.dumps(facts).encode(), **{name: encode(*octree) for name, octree in octrees.items()}}


def write_set(url, splits: dict[str, list[int]], inputs=None, prefix="s", name="tiny", catalogues=True,
              **manifest) -> str:
    """A finished data set: `splits` gives the samples of each shard. Keys are s000, s001, ...; every third
    sample is a lamp, the others are chairs. `catalogues=False` is a data set as earlier versions made it.
    """
    store, number, entries = Store(url), 0, {}
    inputs = {"v4": ["histogram"]} if inputs is None else inputs
    for split, sizes in splits.items():
        entries[split] = []
        for shard, size in enumerate(sizes):
            with ShardWriter(store, split, shard) as writer:
                for _ in range(size):
                    key, category = f"{prefix}{number:03d}", "lamp" if number % 3 == 2 else "chair"
                    writer.add(key, make_members(key, number, category, inputs))
                    number += 1
            entries[split].append(writer.entry)
    counts = Counts(items=number, samples=number, failures=0, exclusions=0)
    write_dataset(store, DatasetInfo(
        name=name, fingerprint={}, counts=counts,
        manifest={"truncation_voxels": 2.1333, "target": "tsdf", "normalise": {"extent": 3.0}, **manifest},
        splits={split: tuple(found) for split, found in entries.items()}))
    if catalogues:
        restore_catalogues(store)
    return str(url)


@pytest.fixture(scope="session")
def sets() -> SimpleNamespace:
    """The helpers above."""
    return SimpleNamespace(write=write_set, members=make_members, octree=make_octree, decode=decode)


@pytest.fixture(scope="session")
def eleven(tmp_path_factory) -> str:
    """11 training samples in 5 shards of uneven size, 4 test samples in 3."""
    return write_set(tmp_path_factory.mktemp("eleven"), {"train": [3, 1, 4, 1, 2], "test": [2, 1, 1]})
