"""Samples one at a time, decoded, for tools that look at a data set (training reads with `ShardDataset`)."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.octree import GridOctree
from ocnf_data.octree.codec import decode
from ocnf_data.shards.catalogue import load_catalogue
from ocnf_data.shards.dataset import DatasetInfo, load_dataset
from ocnf_data.shards.index import SampleEntry
from ocnf_data.shards.reader import ShardReader
from ocnf_data.shards.tarformat import JSON


@dataclass(frozen=True)
class StoredSample:
    """One sample of a data set; members are read, checked and decoded when asked for.

    Attributes:
        reader: reader of the shard that holds the sample.
        position: number of the sample in the shard, from 0.
        entry: what the index says of it.
    """

    reader: ShardReader
    position: int
    entry: SampleEntry

    @property
    def key(self) -> str:
        """The sample's name."""
        return self.entry.key

    @property
    def split(self) -> str:
        """The split it belongs to."""
        return self.reader.split

    @cached_property
    def facts(self) -> dict[str, Any]:
        """The `json` member: source, normalisation, cameras, seed, leaf counts (docs/format.md)."""
        facts: dict[str, Any] = json.loads(self._payload(JSON))
        return facts

    def octree(self, member: str) -> GridOctree:
        """An octree member by name, e.g. `target-64.oct`."""
        return decode(self._payload(member))

    def _payload(self, member: str) -> bytes:
        return self.reader.read(self.position, [member])[member]


def stored_samples(url: str | Store, info: DatasetInfo | None = None) -> Iterator[StoredSample]:
    """All samples of a data set, in the order of its splits and shards.

    Raises:
        OcnfError: whatever `load_dataset` and `ShardReader` raise.
    """
    store = url if isinstance(url, Store) else Store(url)
    for split, entry in (info or load_dataset(store)).shards():
        with ShardReader(store, split, entry) as reader:
            for position, sample in enumerate(reader.index.samples):
                yield StoredSample(reader, position, sample)


def find_sample(url: str | Store, key: str) -> StoredSample:
    """The sample of that key.

    Raises:
        OcnfError: there is none (`missing`).
    """
    store = url if isinstance(url, Store) else Store(url)
    info = load_dataset(store)
    for split, entries in info.splits.items():
        catalogue = load_catalogue(store, info, split)
        if (place := catalogue.find(key)) is not None:
            shard, position = place
            reader = ShardReader(store, split, entries[shard])
            return StoredSample(reader, position, reader.index.samples[position])
    raise OcnfError("the data set has no such sample", code="missing", where=url, field=key,
                    fix="list the keys with `ocnf-data info DIR --samples`")
