"""`dataset.json`: what a data set is and what it consists of; the authority over every other file.

    {"schema": 1, "name": "demo", "manifest": {...resolved...}, "fingerprint": ...,
     "counts": {"items": 100, "samples": 98, "failures": 1, "exclusions": 1},
     "splits": {"train": [{"shard": "shard-000000.tar", "bytes": ..., "sha256": ..., "index_sha256": ...,
                           "samples": 16}, ...], ...},
     "files": [{"name": "failures.jsonl", "bytes": ..., "sha256": ...},
               {"name": "train/catalogue.safetensors", ...}, ...],
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
from ocnf_data.shards.index import ShardIndex, ShardName, catalogue_path, check_split

DATASET = "dataset.json"
FAILURES = "failures.jsonl"
PLAN = "plan.json"
MAX_DATASET_BYTES = 256 * 2**20
DAMAGE = frozenset({"checksum", "invalid", "too_large"})
"""The codes of `load_dataset` for a file that is not as it was written."""

_FIELDS = ("bytes", "index_sha256", "samples", "sha256", "shard")
_VALUES = ("%d", '"%s"', "%d", '"%s"', '"%s"')
# A shard's entry as canonical JSON, by the indentation of the file.
_ENTRY = {
    None: "{" + ",".join(f'"{name}":{value}' for name, value in zip(_FIELDS, _VALUES, strict=True)) + "}",
    1: "\n   {\n" + ",\n".join(f'    "{name}": {value}'
                               for name, value in zip(_FIELDS, _VALUES, strict=True)) + "\n   }",
}


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
    """Another file of the data set that may not change: `plan.json`, `failures.jsonl`, a catalogue."""

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
        body = self._body()
        checksum = sha256_hex(self._canonical(body))
        return self._canonical({**body, "checksum": checksum}, indent=1)

    @property
    def identity(self) -> str:
        """What tells this data set from others: `checksum` as it would be without the catalogues.

        A catalogue follows from the indices, so a data set that gains one, or gets it made again, is the same
        data set: a training run that was begun on it goes on.
        """
        derived = {catalogue_path(split) for split in self.splits}
        files = tuple(entry for entry in self.files if entry.name not in derived)
        if len(files) == len(self.files) and self.checksum:
            return self.checksum
        return sha256_hex(self._canonical(self.model_copy(update={"files": files})._body()))

    def file(self, name: str) -> FileEntry | None:
        """The entry of one of `files`; None where there is none of that name."""
        return next((entry for entry in self.files if entry.name == name), None)

    def _body(self) -> dict[str, Any]:
        """Everything that the checksum covers, but the splits."""
        return self.model_dump(mode="json", by_alias=True, exclude={"checksum", "splits"})

    def _canonical(self, body: dict[str, Any], indent: int | None = None) -> bytes:
        """`canonical_json` of the body and the splits, which are the last of its fields.

        The splits are put together here: of 60,000 shards, json needs seconds to indent them.
        """
        lists = {split: [_ENTRY[indent] % (entry.size, entry.index_sha256, entry.samples, entry.sha256,
                                           entry.shard) for entry in self.splits[split]]
                 for split in sorted(self.splits)}
        head = canonical_json({**body, "splits": {}}, indent)
        if not lists:
            return head
        if indent is None:
            inner = ",".join(f'"{split}":[{",".join(entries)}]' for split, entries in lists.items())
            return head.removesuffix(b"{}}\n") + f"{{{inner}}}}}\n".encode("ascii")
        inner = ",\n".join(f'  "{split}": [' + ",".join(entries) + ("\n  ]" if entries else "]")
                           for split, entries in lists.items())
        return head.removesuffix(b"{}\n}\n") + f"{{\n{inner}\n }}\n}}\n".encode("ascii")

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
    try:
        blob = store.read_at_most(DATASET, MAX_DATASET_BYTES)
    except OcnfError as error:
        if error.code != "missing":
            raise
        raise OcnfError("there is no finished data set here", code="missing", where=store.where(DATASET),
                        fix="run `ocnf-data generate`; it resumes what was interrupted") from None
    try:
        return DatasetInfo.from_json(blob, store.where(DATASET), MAX_DATASET_BYTES)
    except OcnfError as error:
        if error.code not in DAMAGE:
            raise
        raise error.replaced(fix="`ocnf-data repair` writes it again from plan.json and the shards") from None


def find_dataset(url: str | Store, damage: frozenset[str] = DAMAGE) -> DatasetInfo | None:
    """`load_dataset`, or None where the file is there and damaged.

    Args:
        url: folder or fsspec URL.
        damage: the codes that are taken for damage; all others are raised.
    """
    try:
        return load_dataset(url)
    except OcnfError as error:
        if error.code not in damage:
            raise
        return None
