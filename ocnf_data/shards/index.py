"""The index of a shard: what lies where in its tar, with checksums; a pure function of the tar's bytes.

    {"schema": 1, "split": "train", "shard": "shard-000000.tar", "size": ..., "sha256": of the whole tar,
     "samples": [{"key": "chair_0001", "category": "chair", "source": "chair/train/chair_0001.off",
                  "members": [{"name": "json", "offset": 512, "size": 931, "sha256": ...},
                              {"name": "target-64.oct", "offset": 2048, ...}, ...],
                  "leaf_counts": {"target-64.oct": 25117, ...}}, ...]}

`offset` is that of the payload, in bytes from the start of the tar. Category, source and leaf counts are
those of the sample's own `json` member, so the index can be made again from the tar alone
(`walk.index_from_tar`). It holds no times: those go to `timings/`, which no checksum covers, so that equal
data gives equal files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import SCHEMA_VERSION, Count, Record, Sha256, Text
from ocnf_data.shards.tarformat import (
    BLOCK,
    JSON,
    TRAILER,
    check_key,
    check_member,
    max_size,
    stored_size,
    tar_name,
)

MAX_SAMPLES = 100_000
MAX_MEMBERS = 1_000
MAX_INDEX_BYTES = 64 * 2**20
_SPLIT = re.compile(r"[a-z][a-z0-9_]{0,31}", re.ASCII)
_SHARD_PATH = re.compile(rf"{_SPLIT.pattern}/shard-[0-9]{{6}}\.tar", re.ASCII)
_FOLDERS = frozenset({"failures", "quarantine", "timings", "views"})  # kept beside the splits

ShardName = Annotated[str, Field(pattern=r"^shard-[0-9]{6}\.tar$")]
LeafCount = Annotated[int, Field(ge=1, le=2**31 - 1)]


class Member(Record):
    """One file of a sample: its name without the key, where its payload starts, and what it must hash to."""

    name: Text
    offset: Count
    size: Count
    sha256: Sha256


class SampleEntry(Record):
    """One sample; `leaf_counts` has an entry for each octree among the members."""

    key: Text
    category: Text
    source: Text
    members: Annotated[tuple[Member, ...], Field(min_length=1, max_length=MAX_MEMBERS)]
    leaf_counts: dict[str, LeafCount]

    def member(self, name: str) -> Member:
        """The member of that name; OcnfError (`missing`) where the sample has none."""
        for member in self.members:
            if member.name == name:
                return member
        raise OcnfError("the sample has no such member", code="missing", where=self.key, field=name,
                        expected=", ".join(member.name for member in self.members))


class ShardIndex(Record):
    """The index of one shard. Validation recomputes the layout, so offsets cannot point anywhere else."""

    schema_version: Annotated[Literal[1], Field(alias="schema")] = SCHEMA_VERSION
    split: Text
    shard: ShardName
    size: Count
    sha256: Sha256
    samples: Annotated[tuple[SampleEntry, ...], Field(max_length=MAX_SAMPLES)]

    @model_validator(mode="after")
    def _layout(self) -> Self:
        try:
            check_split(self.split)
            end = 0
            for sample in self.samples:
                end = _check_sample(sample, end)
        except OcnfError as error:
            raise ValueError(str(error)) from None
        if len({sample.key for sample in self.samples}) != len(self.samples):
            raise ValueError("two samples have the same key")
        if self.size != end + len(TRAILER):
            raise ValueError(f"a tar of {self.size} bytes, where the members call for {end + len(TRAILER)}")
        return self

    def members(self) -> Iterator[tuple[SampleEntry, Member]]:
        """Every member of every sample, in the order of the tar."""
        for sample in self.samples:
            for member in sample.members:
                yield sample, member


class SampleFacts(BaseModel):
    """What the index takes from a sample's `json` member; the member may hold more."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    key: Text
    category: Text
    source: Text
    leaf_counts: dict[str, LeafCount]


def read_facts(payload: bytes, where: object) -> SampleFacts:
    """Key, category, source and leaf counts out of a `json` member.

    Raises:
        OcnfError: it is no JSON, or one of them is missing or of another type (`json`).
    """
    try:
        return SampleFacts.model_validate_json(payload)
    except ValidationError as error:
        problem = error.errors(include_url=False, include_context=False)[0]
        raise OcnfError(f"the sample's json member is not valid: {problem['msg']}", code="json",
                        where=where, field=".".join(str(part) for part in problem["loc"]) or None) from None


def make_entry(key: str, hashes: Mapping[str, tuple[int, str]], json: bytes, offset: int) -> SampleEntry:
    """The index entry of a sample whose first header lies at byte `offset` of the tar.

    Args:
        key: the sample's key.
        hashes: (size in bytes, SHA-256) of each member by name, in the order of the tar.
        json: payload of the `json` member.
        offset: a multiple of 512.

    Raises:
        OcnfError: what the format does not allow.
    """
    facts = read_facts(json, tar_name(key, JSON))
    entries, position = [], offset
    for name, (size, sha256) in hashes.items():
        entries.append(Member(name=name, offset=position + BLOCK, size=size, sha256=sha256))
        position += stored_size(size)
    if facts.key != key:
        raise OcnfError("the json member is of another sample", code="json", where=tar_name(key, JSON),
                        field="key", found=facts.key, expected=key)
    entry = SampleEntry(key=key, category=facts.category, source=facts.source, members=tuple(entries),
                        leaf_counts=facts.leaf_counts)
    _check_sample(entry, offset)
    return entry


def check_split(split: str) -> str:
    """The split's name; OcnfError (`name`) unless a folder of a data set may have it."""
    if not _SPLIT.fullmatch(split) or split in _FOLDERS:
        raise OcnfError("not a name for a split", code="name", where=repr(split),
                        expected="1 to 32 of a-z 0-9 _, such as train, val or test")
    return split


def shard_name(number: int) -> str:
    """`shard-000007.tar`; OcnfError (`name`) for a number below 0 or of more than six digits."""
    if not 0 <= number <= 999_999:
        raise OcnfError("a shard's number has six digits", code="name", found=number)
    return f"shard-{number:06d}.tar"


def shard_path(split: str, shard: str) -> str:
    """`train/shard-000007.tar`, relative to the data set."""
    return f"{check_split(split)}/{shard}"


def index_path(split: str, shard: str) -> str:
    """`train/shard-000007.json`, relative to the data set."""
    return f"{check_split(split)}/{shard.removesuffix('.tar')}.json"


def catalogue_path(split: str) -> str:
    """`train/catalogue.safetensors`, relative to the data set."""
    return f"{check_split(split)}/catalogue.safetensors"


def is_shard(name: str) -> bool:
    """Whether a path in a data set is that of a shard."""
    return _SHARD_PATH.fullmatch(name) is not None and name.partition("/")[0] not in _FOLDERS


def _check_sample(sample: SampleEntry, start: int) -> int:
    """Refuse a sample that is not laid out from byte `start` on; the byte after it."""
    check_key(sample.key)
    names = [member.name for member in sample.members]
    for member in sample.members:
        where = tar_name(sample.key, check_member(member.name))
        if member.size > max_size(member.name):
            raise OcnfError("a member is too large", code="too_large", where=where, found=member.size)
        if member.offset != start + BLOCK:
            raise OcnfError("a member lies elsewhere", code="layout", where=where, found=member.offset,
                            expected=start + BLOCK)
        start += stored_size(member.size)
    # webdataset reads names in lower case, so two that differ in case only would become one
    if len({name.lower() for name in names}) != len(names) or names[0] != JSON:
        raise OcnfError("members are json, then octrees of different names", code="layout", where=sample.key,
                        found=names)
    if set(sample.leaf_counts) != set(names[1:]):
        raise OcnfError("leaf counts are not those of the octree members", code="json", where=sample.key,
                        field="leaf_counts", found=sorted(sample.leaf_counts), expected=sorted(names[1:]))
    return start
