"""The plan of a data set: every item, its key, its checksum and its shard, fixed before anything is made.

    {"schema": 1, "manifest": {...resolved...}, "fingerprint": {"libraries": {...}, "cpu": "..."},
     "shards": {"train": [[{"key": "chair_0001", "source": "chair/train/chair_0001.off", ...}, ...], ...]},
     "exclusions": [...]}

Items keep their shard whatever fails later: gaps are not refilled, so one bad mesh moves no other sample.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from json.encoder import encode_basestring_ascii as _encode
from pathlib import Path, PurePosixPath
from typing import Any

from ocnf_data.errors import OcnfError, printable
from ocnf_data.files.records import canonical_json
from ocnf_data.generation.fingerprint import fingerprint
from ocnf_data.generation.procedural import configuration_name, procedural_name
from ocnf_data.generation.records import EXCLUDED, Failure, Item, ShardPlan
from ocnf_data.manifest import SPLITS, Entry, Manifest
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.shards.tarformat import MAX_KEY, MAX_NAME, input_member, target_member

PLAN_SCHEMA = 1
_HASHING_THREADS = 8
_HASHING_BYTES = 1 << 20  # between two looks at whether the run was interrupted
_SUFFIX = 9  # "-" and 8 hexadecimal digits
_SHORTEST_LIMIT = 24


@dataclass(frozen=True)
class Plan:
    """What is to be made, and out of what.

    Attributes:
        manifest: resolved, as plain values.
        fingerprint: versions of the libraries and type of the CPU, by `generation.fingerprint`.
        shards: the shards, sorted by split, then number.
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
        return b"".join(self.pieces())

    def pieces(self) -> Iterator[bytes]:
        """The bytes of `plan.json`, about a shard at a time: canonical JSON, indented by one blank.

        The whole text of a million items would take more memory than the plan does, and Python's own encoder
        three times as long as planning.
        """
        text = canonical_json({
            "schema": PLAN_SCHEMA,
            "manifest": self.manifest,
            "fingerprint": self.fingerprint,
            "shards": {},
            "exclusions": [row.to_json() for row in self.exclusions],
        }, indent=1)
        yield text.removesuffix(b"{}\n}\n")  # the shards come last of the sorted fields
        before = b"{\n"
        for split in sorted(self.splits):
            yield before + f"  {_encode(split)}: [\n".encode()
            lists = (_encode_items(shard.items) for shard in self.shards if shard.split == split)
            for n, items in enumerate(lists):
                yield (b",\n" if n else b"") + items
            before = b"\n  ],\n"
        yield b"\n  ]\n }\n}\n" if self.shards else b"{}\n}\n"

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> Plan:
        """Inverse of `to_json`, from its parsed JSON. KeyError, TypeError or ValueError where it is none."""
        shards = tuple(ShardPlan(split, number, tuple(Item.from_json(row) for row in rows))
                       for split in sorted(raw["shards"], key=SPLITS.index)
                       for number, rows in enumerate(raw["shards"][split]))
        return cls(dict(raw["manifest"]), dict(raw["fingerprint"]), shards,
                   tuple(Failure.from_json(row) for row in raw["exclusions"]))


def make_plan(manifest: Manifest, meshes: Path | None, splits: Sequence[str] = SPLITS) -> Plan:
    """List, name, checksum and order the items of a manifest.

    Args:
        manifest: the manifest of the data set.
        meshes: the folder that mesh paths are relative to; None for procedural shapes.
        splits: which of them; the others are left out as if the manifest had none of their items.

    Raises:
        OcnfError: the folder or a category is missing or empty, a key or a variant's name is too long, a
            split is none, or none of those asked for has an item (`empty`).
    """
    items, exclusions = list_items(manifest, meshes, splits)
    if not items and not exclusions:
        there = {entry.split for entry in manifest.entries(meshes)}
        raise OcnfError("the manifest has no item in the splits that are asked for", code="empty",
                        where=manifest.name, field="splits", found=", ".join(splits) or "none",
                        expected=", ".join(split for split in SPLITS if split in there) or None)
    size = manifest.shards.samples
    shards = []
    for split in SPLITS:
        order = sorted((item for item in items if item.split == split),
                       key=lambda item: _rank(manifest.seed, item))
        shards += [ShardPlan(split, n, tuple(order[start:start + size]))
                   for n, start in enumerate(range(0, len(order), size))]
    marks = fingerprint(reads_files=meshes is not None, renders_with_gl=manifest.renderer == "pyrender")
    return Plan(manifest.to_dict(), marks, tuple(shards), tuple(exclusions))


def list_items(manifest: Manifest, meshes: Path | None,
               splits: Sequence[str] = SPLITS) -> tuple[list[Item], list[Failure]]:
    """The items of some splits with their keys and checksums, in the source's order; and what is left out.

    A mesh has the same key whichever splits are asked for. Arguments and errors as for `make_plan`, but that
    none of these splits need have an item.
    """
    check_splits(splits, "splits")
    if meshes is not None and not meshes.is_dir():
        raise OcnfError("the folder of the meshes or scans is not there", code="missing", where=meshes,
                        field="source.root", fix="give it as --meshes ROOT")
    found = manifest.entries(meshes)
    entries, exclusions = _distinct([entry for entry in found if entry.excluded is None], meshes)
    exclusions += [_exclusion(entry, entry.excluded) for entry in found if entry.excluded is not None]
    keys = make_keys(entries, _key_limit(manifest))
    wanted = [(key, entry) for key, entry in zip(keys, entries, strict=True) if entry.split in splits]
    if isinstance(manifest.source, SequenceSource) and meshes is not None:
        sums = _scan_checksums([entry for _, entry in wanted], manifest.source, meshes)
    else:
        sums = _checksums([entry for _, entry in wanted], meshes, manifest.limits.max_bytes)
    items = [Item(key, entry.split, entry.category, entry_source(entry), sha256, entry.index)
             for (key, entry), sha256 in zip(wanted, sums, strict=True)]
    return items, [row for row in exclusions if row.split in splits]


def check_splits(splits: Sequence[str], field: str) -> None:
    """Refuse names that no split has: taken for one without meshes, a slip of the pen gives an empty set."""
    if isinstance(splits, str):
        raise OcnfError("not a list of splits", field=field, found=splits, expected=f"[{splits!r}]")
    for split in splits:
        if split not in SPLITS:
            raise OcnfError("no split of a manifest", code="missing", field=field, found=split,
                            expected=", ".join(SPLITS))


def make_keys(entries: Sequence[Entry], limit: int = MAX_KEY) -> list[str]:
    """A key for each entry: readable, at most `limit` characters of [A-Za-z0-9_-], no two alike in any case.

    `chair/train/chair_0001.off` becomes `chair_0001`, `car/train/m 1.obj` becomes `car-train-m_1-0c26bd6b`:
    where characters had to go, or two keys would be alike, a digest of the path tells them apart.
    OcnfError where a key that an entry brings is too long, or two are alike all the same.
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
            path = f"{entry.split}/{entry_source(entry)}".encode(errors="surrogatepass")
            digest = hashlib.sha256(path).hexdigest()
            name = f"{name[:limit - _SUFFIX]}-{digest[:_SUFFIX - 1]}"
        keys.append(name)
    twice = [key for key, n in Counter(key.lower() for key in keys).items() if n > 1]
    if twice:
        made = any(entry.path is None for key, entry in zip(keys, entries, strict=True)
                   if key.lower() == twice[0])
        raise OcnfError("two items have the same key, if case is ignored",
                        field="source.parts" if made else "source.items",
                        found=twice[0], expected="keys of their own",
                        fix="name each category of shapes or scenes in one part alone" if made else None)
    return keys


def _readable(entry: Entry) -> str:
    if entry.key is not None:
        return entry.key
    if entry.path is None:
        return f"{entry.category}-{entry.split}-{entry.index:04d}"
    if entry.index is not None:
        return f"{entry.category}-{entry.split}-{entry.index:04d}"
    path = PurePosixPath(entry.path)
    if path.stem.startswith(entry.category):
        return path.stem
    return "-".join((*(part for part in path.parts[:-1] if part != "/"), path.stem))


def entry_source(entry: Entry) -> str:
    """What `Item.source` says of an entry."""
    if entry.path is not None:
        return entry.path if entry.index is None else configuration_name(entry.path, entry.index)
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
    first: dict[str, Entry] = {}
    for entry in entries:
        if entry.path is None or entry.index is not None:
            kept.append(entry)
            continue
        known = first.setdefault(_identity(meshes / entry_source(entry)), entry)
        if known is entry:
            kept.append(entry)
        else:
            excluded.append(_exclusion(entry, f"is the same file as {known.split}'s {entry_source(known)}"))
    return kept, excluded


def _identity(path: Path) -> str:
    """What two names of one file share; of one that cannot be followed, such as a ring of links, its own."""
    try:
        return os.path.realpath(path, strict=True)
    except (OSError, ValueError):  # ValueError: a null byte in the name
        return str(path)


def _exclusion(entry: Entry, why: str) -> Failure:
    source = printable(entry_source(entry))
    return Failure(source, entry.split, printable(entry.category), source, "plan", EXCLUDED, printable(why))


def _checksums(entries: Sequence[Entry], meshes: Path | None, max_bytes: int) -> list[str | None]:
    """SHA-256 of each mesh file.

    None for a procedural shape, and for what will be refused unread: no plain file, more than `max_bytes`.
    An interrupt ends all threads within one `_HASHING_BYTES`.
    """
    stop = threading.Event()

    def checksum(entry: Entry) -> str | None:
        if meshes is None or entry.path is None:
            return None
        path = meshes / entry.path
        try:
            # Looked at first: opening a pipe would wait for ever, and reading a terabyte nearly so.
            if not path.is_file() or path.stat().st_size > max_bytes:
                return None
            digest, left = hashlib.sha256(), max_bytes + 1
            with path.open("rb") as file:
                while not stop.is_set() and (data := file.read(min(_HASHING_BYTES, left))):
                    digest.update(data)
                    left -= len(data)
        except (OSError, ValueError):  # its item will fail and say why
            return None
        return digest.hexdigest() if left > 0 else None  # none where it grew meanwhile

    with ThreadPoolExecutor(_HASHING_THREADS) as pool:
        try:
            return list(pool.map(checksum, entries))
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _scan_checksums(entries: Sequence[Entry], source: SequenceSource, root: Path) -> list[str | None]:
    """The checksum of each entry's scan, taken once a scan; None where a depth map cannot be read."""
    sums: dict[str, str | None] = {}
    for entry in entries:
        path = entry.path or ""
        if path not in sums:
            try:
                sums[path] = source.open(root, path).checksum()
            except OcnfError:  # its items will fail and say why
                sums[path] = None
    return [sums[entry.path or ""] for entry in entries]


def _encode_items(items: Sequence[Item]) -> bytes:
    """A shard's items as JSON, indented as they stand in `plan.json`."""
    rows = []
    for item in items:
        sha256 = "null" if item.sha256 is None else _encode(item.sha256)
        index = "null" if item.index is None else item.index
        rows.append(f"""    {{
     "category": {_encode(item.category)},
     "index": {index},
     "key": {_encode(item.key)},
     "sha256": {sha256},
     "source": {_encode(item.source)},
     "split": {_encode(item.split)}
    }}""")
    return ("   [\n" + ",\n".join(rows) + "\n   ]").encode("ascii")


def _rank(seed: int, item: Item) -> str:
    """Sorting by this shuffles a split, so that shards mix categories, without a library's random numbers."""
    return hashlib.sha256(json.dumps([seed, item.split, item.key]).encode()).hexdigest()
