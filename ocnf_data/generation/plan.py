"""The plan of a data set: every item, its key, its checksum and its shard, fixed before anything is made.

    {"schema": 1, "manifest": {...resolved...}, "fingerprint": {"libraries": {...}, "cpu": "..."},
     "shards": {"train": [[{"key": "chair_0001", "source": "chair/train/chair_0001.off", ...}, ...], ...]},
     "exclusions": [...]}

Items keep their shard whatever fails later: gaps are not refilled, so one bad mesh moves no other sample.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.generation.fingerprint import fingerprint
from ocnf_data.generation.procedural import procedural_name
from ocnf_data.generation.records import EXCLUDED, Failure, Item, ShardPlan
from ocnf_data.manifest import SPLITS, Entry, Manifest
from ocnf_data.shards.tarformat import MAX_KEY, MAX_NAME, input_member, target_member

PLAN_SCHEMA = 1
_HASHING_THREADS = 8
_SUFFIX = 9  # "-" and 8 hexadecimal digits
_SHORTEST_LIMIT = 24


@dataclass(frozen=True)
class Plan:
    """What is to be made, and out of what.

    Attributes:
        manifest: resolved, as plain values.
        fingerprint: see `fingerprint`.
        shards: by split, then number.
        exclusions: inputs that are left out on purpose.
    """

    manifest: dict[str, Any]
    fingerprint: dict[str, Any]
    shards: tuple[ShardPlan, ...]
    exclusions: tuple[Failure, ...] = ()

    @property
    def items(self) -> tuple[Item, ...]:
        """All items, in the order of their shards."""
        return tuple(item for shard in self.shards for item in shard.items)

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits that have items."""
        return tuple(dict.fromkeys(shard.split for shard in self.shards))

    def to_json(self) -> bytes:
        """The bytes of `plan.json`."""
        shards: dict[str, list[Any]] = {split: [] for split in self.splits}
        for shard in self.shards:
            shards[shard.split].append([item.to_json() for item in shard.items])
        return canonical_json({
            "schema": PLAN_SCHEMA,
            "manifest": self.manifest,
            "fingerprint": self.fingerprint,
            "shards": shards,
            "exclusions": [row.to_json() for row in self.exclusions],
        }, indent=1)

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> Plan:
        """Inverse of `to_json`, from its parsed JSON. KeyError, TypeError or ValueError where it is none."""
        shards = tuple(ShardPlan(split, number, tuple(Item.from_json(row) for row in rows))
                       for split in sorted(raw["shards"], key=SPLITS.index)
                       for number, rows in enumerate(raw["shards"][split]))
        return cls(dict(raw["manifest"]), dict(raw["fingerprint"]), shards,
                   tuple(Failure.from_json(row) for row in raw["exclusions"]))


def make_plan(manifest: Manifest, meshes: Path | None) -> Plan:
    """List, name, checksum and order the items of a manifest.

    Args:
        manifest: what to make.
        meshes: the folder that mesh paths are relative to; None for procedural shapes.

    Raises:
        OcnfError: the folder or a category is missing or empty, a key or a variant's name is too long.
    """
    if meshes is not None and not meshes.is_dir():
        raise OcnfError("the folder of the meshes is not there", code="missing", where=meshes,
                        field="source.root", fix="give it as --meshes ROOT")
    entries = manifest.source.entries(meshes, manifest.seed)
    entries, exclusions = _distinct(entries, meshes)
    keys = make_keys(entries, _key_limit(manifest))
    sums = _checksums(entries, meshes)
    items = [Item(key, entry.split, entry.category, _source(entry), sha256, entry.index)
             for key, entry, sha256 in zip(keys, entries, sums, strict=True)]
    size = manifest.shards.samples
    shards = []
    for split in SPLITS:
        order = sorted((item for item in items if item.split == split),
                       key=lambda item: _rank(manifest.seed, item))
        shards += [ShardPlan(split, n, tuple(order[start:start + size]))
                   for n, start in enumerate(range(0, len(order), size))]
    marks = fingerprint(reads_files=meshes is not None, renders_with_gl=manifest.renderer == "pyrender")
    return Plan(manifest.to_dict(), marks, tuple(shards), tuple(exclusions))


def make_keys(entries: Sequence[Entry], limit: int = MAX_KEY) -> list[str]:
    """A key for each entry: readable, at most `limit` characters of [A-Za-z0-9_-], no two alike in any case.

    `chair/train/chair_0001.off` becomes `chair_0001`, `car/train/m 1.obj` becomes `car-train-m_1-0c26bd6b`:
    where characters had to go, or two keys would be alike, a digest of the path tells them apart.
    """
    wanted = [_readable(entry) for entry in entries]
    plain = [re.sub(r"[^A-Za-z0-9_-]", "_", name) for name in wanted]
    count = Counter(name.lower() for name in plain)
    keys = []
    for entry, want, name in zip(entries, wanted, plain, strict=True):
        if entry.key is not None and len(entry.key) > limit:
            raise OcnfError("a key is too long", field="source.items", found=entry.key,
                            expected=f"at most {limit} characters")
        if entry.key is None and (name != want or len(name) > limit or count[name.lower()] > 1):
            digest = hashlib.sha256(f"{entry.split}/{_source(entry)}".encode()).hexdigest()
            name = f"{name[:limit - _SUFFIX]}-{digest[:_SUFFIX - 1]}"
        keys.append(name)
    twice = [key for key, n in Counter(key.lower() for key in keys).items() if n > 1]
    if twice:
        raise OcnfError("two items have the same key, if case is ignored", field="source.items",
                        found=twice[0], expected="keys of their own")
    return keys


def _readable(entry: Entry) -> str:
    if entry.key is not None:
        return entry.key
    if entry.path is None:
        return f"{entry.category}-{entry.split}-{entry.index:04d}"
    path = PurePosixPath(entry.path)
    if path.stem.startswith(entry.category):
        return path.stem
    return "-".join((*(part for part in path.parts[:-1] if part != "/"), path.stem))


def _source(entry: Entry) -> str:
    if entry.path is not None:
        return entry.path
    return procedural_name(entry.category, entry.split, entry.index or 0)


def _key_limit(manifest: Manifest) -> int:
    """How long keys may be, so that every member's name fits into a tar's header."""
    finest = manifest.resolutions[-1]
    members = [target_member(finest), *(input_member(variant.name, encoding, finest)
                                        for variant in manifest.inputs for encoding in variant.encodings)]
    longest = max(members, key=len)
    limit = min(MAX_KEY, MAX_NAME - 1 - len(longest))
    if limit < _SHORTEST_LIMIT:
        raise OcnfError("an input's name is too long for the members' names in a tar", field="inputs.name",
                        found=longest, expected=f"at most {MAX_NAME - 1 - _SHORTEST_LIMIT} characters in all")
    return limit


def _distinct(entries: Sequence[Entry], meshes: Path | None) -> tuple[list[Entry], list[Failure]]:
    """Leave out a file that an earlier entry names already, by way of a link or an absolute path."""
    if meshes is None:
        return list(entries), []
    kept: list[Entry] = []
    excluded: list[Failure] = []
    first: dict[Path, Entry] = {}
    for entry in entries:
        known = first.setdefault((meshes / _source(entry)).resolve(), entry)
        if known is entry:
            kept.append(entry)
        else:
            source = _source(entry)
            excluded.append(Failure(source, entry.split, entry.category, source, "plan", EXCLUDED,
                                    f"is the same file as {known.split}'s {_source(known)}"))
    return kept, excluded


def _checksums(entries: Sequence[Entry], meshes: Path | None) -> list[str | None]:
    """SHA-256 of each mesh file; None for a procedural shape, and for a file that cannot be read."""
    if meshes is None:
        return [None] * len(entries)

    def checksum(entry: Entry) -> str | None:
        path = meshes / _source(entry)
        try:
            if not path.is_file():  # opening a pipe would wait for ever
                return None
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError:  # its item will fail and say why
            return None

    with ThreadPoolExecutor(_HASHING_THREADS) as pool:
        return list(pool.map(checksum, entries))


def _rank(seed: int, item: Item) -> str:
    """Sorting by this shuffles a split, so that shards mix categories, without a library's random numbers."""
    return hashlib.sha256(json.dumps([seed, item.split, item.key]).encode()).hexdigest()
