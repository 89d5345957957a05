"""From a sample's number to its checked octrees: the work that a loader's worker process does.

Reading is by offset, so any order of samples will do, and members that nobody asked for are never touched.
Members that lie next to each other come in one read; over a network, so do those with little between them.
Every check of `shards.reader` is made on every read: header, padding and SHA-256 of each member, the size of
the tar when it is first opened, its last blocks with its last sample. Nothing is kept between samples but
a few open files.
"""

from __future__ import annotations

import json
import os
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import IO, Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store, storage_errors
from ocnf_data.loading.catalogue import Catalogue, Shard
from ocnf_data.octree.codec import decode_raw
from ocnf_data.octree.stored import TARGET, RawOctree
from ocnf_data.octree.symmetry import Symmetry
from ocnf_data.shards.faults import end_faults, member_faults
from ocnf_data.shards.index import Member
from ocnf_data.shards.reader import check_size
from ocnf_data.shards.tarformat import BLOCK, JSON, TRAILER, padding, parse_member

ReadRange = Callable[[int, int], bytes]
"""The bytes from a start to an end; fewer where the tar ends, which the checks tell with key and member."""

_OPEN_FILES = 16
_REMOTE_GAP = 512 * 2**10  # bytes that are cheaper to fetch than a second request


@dataclass(frozen=True, eq=False)
class RawSample:
    """A sample as it is stored; `octrees` by member name."""

    key: str
    category: str
    meta: dict[str, Any]
    octrees: dict[str, RawOctree]

    def moved(self, symmetry: Symmetry) -> RawSample:
        """All octrees under one symmetry; `meta` still speaks of the sample as it was."""
        octrees = {name: symmetry(octree) for name, octree in self.octrees.items()}
        return RawSample(self.key, self.category, self.meta, octrees)


class Fetcher:
    """Reads samples of a catalogue. Picklable and safe to fork: each process opens its own files."""

    def __init__(self, catalogue: Catalogue) -> None:
        self.catalogue = catalogue
        self._sources: OrderedDict[Shard, _Source] = OrderedDict()
        self._process = os.getpid()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_sources": OrderedDict()}

    def fetch(self, sample: int) -> RawSample:
        """Read, check and decode a sample.

        Raises:
            OcnfError: names the shard, the key, the member and its byte offset.
        """
        catalogue = self.catalogue
        key = catalogue.keys[sample]
        source = self._source(catalogue.shards[catalogue.shard_of[sample]])
        members = catalogue.members(sample)
        try:
            payloads = source.read(key, members, bool(catalogue.closes[sample]))
        except OcnfError as error:
            raise _about(error, source.where, error.field or key) from None
        meta: dict[str, Any] = {}
        octrees: dict[str, RawOctree] = {}
        for member, payload in zip(members, payloads, strict=True):
            try:
                if member.name == JSON:
                    meta = _parse_meta(payload)
                else:
                    octrees[member.name] = _decode(member.name, payload)
            except OcnfError as error:
                raise _about(error, source.where, f"{key}.{member.name} at byte {member.offset}") from None
        return RawSample(key, catalogue.categories[sample], meta, octrees)

    def _source(self, shard: Shard) -> _Source:
        if self._process != os.getpid():  # forked: the parent's file positions and sockets are not ours
            self._sources = OrderedDict()
            self._process = os.getpid()
        if shard not in self._sources:
            self._sources[shard] = _Source(shard)
            if len(self._sources) > _OPEN_FILES:
                self._sources.popitem(last=False)[1].close()
        self._sources.move_to_end(shard)
        return self._sources[shard]


class _Source:
    """One tar, open for reading ranges."""

    def __init__(self, shard: Shard) -> None:
        self._shard = shard
        self._store = Store(shard.url)
        self._checked = False
        self._file: IO[bytes] | None = None
        self.where = self._store.where(shard.name)

    def read(self, key: str, members: list[Member], closes: bool) -> list[bytes]:
        """Payloads of the members; with `closes`, the last blocks of the tar are checked too."""
        if not self._checked:
            check_size(self._store, self._shard.name, self._shard.size)
            self._checked = True
        trailer = (self._shard.size - len(TRAILER), self._shard.size)
        extents = [_extent(member) for member in members] + ([trailer] if closes else [])
        payloads = []
        with storage_errors(self.where):
            read = self._local() if self._store.is_local else self._remote(extents)
            for member in members:
                start, end = _extent(member)
                payload_end = member.offset + member.size
                header, payload = read(start, member.offset), read(member.offset, payload_end)
                for fault in member_faults(key, member, header, payload, read(payload_end, end)):
                    raise fault.error(self.where)
                payloads.append(payload)
            if closes:
                for fault in end_faults(read(*trailer), self._shard.size):
                    raise fault.error(self.where)
        return payloads

    def _local(self) -> ReadRange:
        file = self._file = self._file or self._store.open(self._shard.name)

        def read(start: int, end: int) -> bytes:
            file.seek(start)
            return file.read(end - start)

        return read

    def _remote(self, extents: list[tuple[int, int]]) -> ReadRange:
        pieces = {start: memoryview(self._store.read_range(self._shard.name, start, end - start))
                  for start, end in _merge(extents, _REMOTE_GAP)}

        def read(start: int, end: int) -> bytes:
            base = max(first for first in pieces if first <= start)
            return bytes(pieces[base][start - base : end - base])

        return read

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def _extent(member: Member) -> tuple[int, int]:
    """First byte of the header, and the byte after the padding."""
    end = member.offset + member.size
    return member.offset - BLOCK, end + padding(end)


def _merge(ranges: list[tuple[int, int]], gap: int) -> Iterator[tuple[int, int]]:
    """Ranges (start, end) joined where at most `gap` bytes lie between them."""
    ordered = sorted(ranges)
    start, end = ordered[0]
    for next_start, next_end in ordered[1:]:
        if next_start - end > gap:
            yield start, end
            start = next_start
        end = next_end
    yield start, end


def _about(error: OcnfError, where: str, field: str) -> OcnfError:
    """The error, said of a place in a shard."""
    return OcnfError(error.what, code=error.code, where=where, field=field, found=error.found,
                     expected=error.expected, fix=error.fix)


def _parse_meta(payload: bytes) -> dict[str, Any]:
    try:
        meta = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise OcnfError("not JSON", code="json", found=error) from None
    if not isinstance(meta, dict):
        raise OcnfError("not a JSON object", code="json", found=type(meta).__name__)
    return meta


def _decode(name: str, payload: bytes) -> RawOctree:
    _, encoding, resolution = parse_member(name)
    return decode_raw(payload, TARGET if encoding is None else str(encoding), resolution)
