"""Checking one shard to the last byte: its index, every header, payload and padding, and every octree."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.octree.codec import decode_raw
from ocnf_data.shards.catalogue import ShardContents
from ocnf_data.shards.dataset import ShardEntry
from ocnf_data.shards.faults import Fault, end_faults, member_faults
from ocnf_data.shards.index import (
    Member,
    SampleEntry,
    SampleFacts,
    ShardIndex,
    index_path,
    read_facts,
    shard_path,
)
from ocnf_data.shards.index_files import read_index
from ocnf_data.shards.tarformat import JSON, TRAILER, parse_member
from ocnf_data.shards.walk import TarWalk, index_from_tar
from ocnf_data.verify.problems import Problem


@dataclass
class ShardReport:
    """What was found in one shard; `contents` is what a catalogue has to say of it, None without an index."""

    path: str
    problems: list[Problem] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)
    contents: ShardContents | None = None
    members: int = 0
    size: int = 0

    def add(self, code: str, what: str, key: str | None = None, member: str | None = None,
            offset: int | None = None) -> None:
        """Note a problem."""
        self.problems.append(Problem(self.path, code, what, key, member, offset))

    def add_faults(self, faults: Iterable[Fault]) -> None:
        """Note what is wrong with the tar's bytes."""
        for fault in faults:
            self.add(fault.code, fault.what, fault.key, fault.member, fault.offset)


def check_shard(store: Store, split: str, shard: str, entry: ShardEntry | None) -> ShardReport:
    """Check one shard and its index.

    Args:
        store: the data set's folder.
        split: the split's name.
        shard: `shard-000000.tar`.
        entry: what `dataset.json` says of it; None where there is no `dataset.json` to say it.
    """
    path = shard_path(split, shard)
    report = ShardReport(path)
    try:
        present = store.exists(path)
        if not present:
            report.add("missing", "the shard is not there")
        index = _stored_index(store, split, shard, entry, report)
        if index is None and present:
            with store.open(path) as file, storage_errors(store.where(path)):
                index = index_from_tar(file, split, shard, store.where(path))
        if index is not None:
            report.keys = [sample.key for sample in index.samples]
            report.contents = ShardContents.of(index)
            if present:
                _check_tar(store, index, entry, report)
    except OcnfError as error:
        report.add(error.code, str(error))
    return report


def _stored_index(store: Store, split: str, shard: str, entry: ShardEntry | None,
                  report: ShardReport) -> ShardIndex | None:
    """The index beside the tar; None where it is lost or damaged, which is reported."""
    name = index_path(split, shard)
    try:
        return read_index(store, split, shard, None if entry is None else entry.index_sha256)
    except OcnfError as error:
        match error.code:
            case "missing":
                report.add("missing_index", f"{name} is not there")
            case "too_large":
                report.add("too_large", f"{name} is too large for an index")
            case "checksum" | "invalid" | "misplaced" | "schema":
                report.add("index", str(error))
            case _:
                raise
    return None


def _check_tar(store: Store, index: ShardIndex, entry: ShardEntry | None, report: ShardReport) -> None:
    """Walk the tar by its index, hashing all of it."""
    with store.open(report.path) as file, storage_errors(store.where(report.path)):
        walk = TarWalk(file)
        cut = False
        for sample, member, raw in walk.along(index):
            faults = list(member_faults(sample.key, member, raw))
            report.add_faults(faults)
            codes = {fault.code for fault in faults}
            if cut := "truncated" in codes:  # and so is everything behind it
                break
            if "checksum" not in codes:
                _check_payload(sample, member, raw.payload, report)
            report.members += 1
        end = walk.take(len(TRAILER) + 1)
        if not cut:
            report.add_faults(end_faults(end, index.size))
        surplus = len(end) > len(TRAILER)  # it may be terabytes, and is not the file whatever it hashes to
        if not surplus:
            walk.to_the_end()
        report.size = walk.offset
    expected = entry.sha256 if entry is not None else index.sha256
    if not surplus and walk.sha256 != expected:
        report.add("sha256", f"the tar has SHA-256 {walk.sha256[:12]}..., not {expected[:12]}...")
    if entry is not None and entry.samples != len(index.samples):
        report.add("count", f"{len(index.samples)} samples, where dataset.json says {entry.samples}")


def _check_payload(sample: SampleEntry, member: Member, payload: bytes, report: ShardReport) -> None:
    """What the payload means: json that agrees with the index, an octree of the right kind, size, leaves."""
    def add(code: str, what: str) -> None:
        report.add(code, what, sample.key, member.name, member.offset)

    try:
        if member.name == JSON:
            facts = read_facts(payload, f"{sample.key}.{JSON}")
            if facts != SampleFacts(**sample.model_dump(exclude={"members"})):
                add("json", "key, category, source or leaf counts are not those of the index")
            return
        _, encoding, resolution = parse_member(member.name)
        octree = decode_raw(payload, "target" if encoding is None else str(encoding), resolution)
    except OcnfError as error:
        add(error.code, str(error))
        return
    if len(octree.data) != sample.leaf_counts[member.name]:
        add("octree", f"{len(octree.data)} leaves, where the index says {sample.leaf_counts[member.name]}")
