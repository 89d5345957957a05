"""`dataset.json`: what a data set is and what it consists of; the authority over every other file.

    {"schema": 1, "name": "demo", "manifest": {...resolved...}, "fingerprint": ...,
     "counts": {"items": 100, "samples": 98, "failures": 1, "exclusions": 1},
     "splits": {"train": [{"shard": "shard-000000.tar", "bytes": ..., "sha256": ..., "index_sha256": ...,
                           "samples": 16}, ...], ...},
     "files": [{"name": "failures.jsonl", "bytes": ..., "sha256": ...}, ...],
     "checksum": SHA-256 of the canonical JSON of everything above}

It is written last: a folder without it is unfinished. It holds no dates and no paths of the machine, so two
runs of one manifest give the same file.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self

from pydantic import Field, JsonValue, model_validator

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import SCHEMA_VERSION, Count, Record, Sha256, Text, canonical_json, sha256_hex
from ocnf_data.files.storage import Store
from ocnf_data.shards.index import ShardIndex, ShardName, check_split

DATASET = "dataset.json"
FAILURES = "failures.jsonl"
PLAN = "plan.json"
MAX_DATASET_BYTES = 256 * 2**20


class ShardEntry(Record):
    """A shard and its index, as `dataset.json` lists them."""

    shard: ShardName
    size: Annotated[Count, Field(alias="bytes")]
    sha256: Sha256
    index_sha256: Sha256
    samples: Count

    @classmethod
    def of(cls, index: ShardIndex) -> Self:
        """The entry of a shard, from its index."""
        return cls(shard=index.shard, size=index.size, sha256=index.sha256,
                   index_sha256=sha256_hex(index.to_json()), samples=len(index.samples))


class FileEntry(Record):
    """Another file of the data set that may not change: `plan.json`, `failures.jsonl`."""

    name: Annotated[str, Field(max_length=200, pattern=r"^\w[\w.-]*(/\w[\w.-]*)*$")]
    size: Annotated[Count, Field(alias="bytes")]
    sha256: Sha256

    @classmethod
    def of(cls, name: str, data: bytes) -> Self:
        """The entry of a file with these bytes."""
        return cls(name=name, size=len(data), sha256=sha256_hex(data))


class Counts(Record):
    """Every input is accounted for: `items = samples + failures + exclusions`."""

    items: Count
    samples: Count
    failures: Count
    exclusions: Count


class DatasetInfo(Record):
    """A finished data set."""

    schema_version: Annotated[Literal[1], Field(alias="schema")] = SCHEMA_VERSION
    name: Text
    manifest: dict[str, JsonValue]
    fingerprint: JsonValue
    counts: Counts
    splits: dict[str, tuple[ShardEntry, ...]]
    files: tuple[FileEntry, ...] = ()
    checksum: str = ""
    """SHA-256 of all else in the file it was read from; `to_json` computes it and does not read this."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        try:
            for split in self.splits:
                check_split(split)
        except OcnfError as error:
            raise ValueError(str(error)) from None
        for shards in self.splits.values():
            if len({entry.shard for entry in shards}) != len(shards):
                raise ValueError("a shard is listed twice")
        stored = sum(entry.samples for _, entry in self.shards())
        if stored != self.counts.samples:
            raise ValueError(f"counts.samples is {self.counts.samples}, the shards hold {stored}")
        accounted = self.counts.samples + self.counts.failures + self.counts.exclusions
        if self.counts.items != accounted:
            raise ValueError(f"counts.items is {self.counts.items}, but {accounted} inputs are accounted for")
        return self

    def to_json(self) -> bytes:
        """The bytes of `dataset.json`."""
        body: dict[str, Any] = self.model_dump(mode="json", by_alias=True, exclude={"checksum"})
        return canonical_json({**body, "checksum": sha256_hex(canonical_json(body))}, indent=1)

    def shards(self) -> Iterator[tuple[str, ShardEntry]]:
        """(split, shard) of all splits."""
        for split, entries in self.splits.items():
            for entry in entries:
                yield split, entry


def write_dataset(store: Store, info: DatasetInfo) -> None:
    """Write `dataset.json`, the last file of a data set."""
    store.put_bytes(DATASET, info.to_json())


def load_dataset(url: str | Store) -> DatasetInfo:
    """Read `dataset.json` of the data set in a folder or under an fsspec URL.

    Raises:
        OcnfError: code `missing` where there is none (the data set is not finished), `schema` for another
            version of the format, `checksum` for a changed or damaged file, `invalid` for anything else.
    """
    store = url if isinstance(url, Store) else Store(url)
    if not store.exists(DATASET):
        raise OcnfError("there is no finished data set here", code="missing", where=store.where(DATASET),
                        fix="run `ocnf-data generate`; it resumes what was interrupted")
    if store.size(DATASET) > MAX_DATASET_BYTES:
        raise OcnfError("the file is too large", code="too_large", where=store.where(DATASET))
    return DatasetInfo.from_json(store.read_bytes(DATASET), store.where(DATASET), MAX_DATASET_BYTES)
