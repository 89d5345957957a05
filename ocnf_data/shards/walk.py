"""The one forward walk through a tar: every byte passes once, in order, and is hashed.

`TarWalk.along(index)` steps where an index says and stops at nothing but the end of the file: `verify` names
everything that is wrong. `TarWalk.by_headers` lets each header say what comes next, where there is no index
yet, and stops at the first byte that this package would not have written.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import IO

from pydantic import ValidationError

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import sha256_hex
from ocnf_data.shards.faults import RawMember
from ocnf_data.shards.index import (
    MAX_MEMBERS,
    MAX_SAMPLES,
    Member,
    SampleEntry,
    ShardIndex,
    make_entry,
)
from ocnf_data.shards.tarformat import BLOCK, JSON, TRAILER, padding, parse_tar_header, tar_name

_PIECE = 2**20


class TarWalk:
    """A tar being read from its first byte to its last.

    Args:
        file: open for reading, at its start.

    Attributes:
        offset: bytes that have passed.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._digest = hashlib.sha256()
        self.offset = 0

    @property
    def sha256(self) -> str:
        """SHA-256 of the bytes that have passed; after `to_the_end`, of the whole tar."""
        return self._digest.hexdigest()

    def along(self, index: ShardIndex) -> Iterator[tuple[SampleEntry, Member, RawMember]]:
        """Every member of the index with the bytes that lie in its place; fewer where the tar ends."""
        for sample, member in index.members():
            yield sample, member, RawMember(self.take(BLOCK), self.take(member.size),
                                            self.take(padding(member.size)))

    def by_headers(self, where: object) -> Iterator[tuple[int, str, str, bytes]]:
        """(byte of the header, key, member name, payload) of every member, as the headers have them, up to
        the first block of zeros.

        Raises:
            OcnfError: a header is not canonical, the tar ends inside a member, or padding is not zero; the
                message has the byte offset.
        """
        while True:
            start = self.offset
            block = self.take(BLOCK)
            if block == TRAILER[:BLOCK]:
                return
            try:
                key, name, size = parse_tar_header(block)
            except OcnfError as error:
                raise OcnfError(error.what, code=error.code, where=where, field=f"header at byte {start}",
                                found=error.found, expected=error.expected) from None
            payload, pad = self.take(size), self.take(padding(size))
            if len(payload) + len(pad) != size + padding(size):
                raise OcnfError("the tar ends inside a member", code="truncated", where=where,
                                field=tar_name(key, name), found=f"{self.offset} bytes")
            if any(pad):
                raise OcnfError("the padding after a member is not zero", code="padding", where=where,
                                field=f"{tar_name(key, name)} at byte {start}")
            yield start, key, name, payload

    def take(self, size: int) -> bytes:
        """The next bytes; fewer where the tar ends."""
        data = self._file.read(size)
        self._digest.update(data)
        self.offset += len(data)
        return data

    def to_the_end(self) -> None:
        """Let the rest of the file pass."""
        while self.take(_PIECE):
            pass


def index_from_tar(file: IO[bytes], split: str, shard: str, where: object) -> ShardIndex:
    """The index of a tar, read from its start to its end; every byte of the tar is checked or hashed.

    That the tar is the one that was written, only its SHA-256 in `dataset.json` can say: the caller compares.

    Raises:
        OcnfError: the tar is not one that this package writes; the message has the byte offset.
    """
    walk = TarWalk(file)
    samples: list[SampleEntry] = []
    start = 0
    for key, hashes, json in _samples(walk, where):
        samples.append(make_entry(key, hashes, json, start))
        if len(samples) > MAX_SAMPLES:
            raise OcnfError("too many samples", code="too_large", where=where, expected=MAX_SAMPLES)
        last = samples[-1].members[-1]
        start = last.offset + last.size + padding(last.size)
    try:
        return ShardIndex(split=split, shard=shard, size=start + len(TRAILER), sha256=walk.sha256,
                          samples=tuple(samples))
    except ValidationError as error:
        raise OcnfError(error.errors(include_url=False)[0]["msg"], code="layout", where=where) from None


def _samples(walk: TarWalk, where: object) -> Iterator[tuple[str, dict[str, tuple[int, str]], bytes]]:
    """(key, size and SHA-256 by member, json) of each sample; at the end the trailer has been checked."""
    current, json = "", b""
    members: dict[str, tuple[int, str]] = {}
    for start, key, name, payload in walk.by_headers(where):
        if name == JSON:
            if members:
                yield current, members, json
            current, members, json = key, {}, payload
        elif key != current or name in members or len(members) >= MAX_MEMBERS:
            raise OcnfError("members of different samples are mixed, or one is there twice", code="layout",
                            where=where, field=f"header at byte {start}", found=tar_name(key, name),
                            expected=f"another member of {current}" if current else "a json member first")
        members[name] = (len(payload), sha256_hex(payload))
    if members:
        yield current, members, json
    start = walk.offset - BLOCK
    if walk.take(BLOCK) != TRAILER[BLOCK:] or walk.take(1):
        raise OcnfError("the tar does not end with two blocks of zeros and nothing else", code="trailer",
                        where=where, field=f"byte {start}")
