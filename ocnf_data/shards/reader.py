"""Reading a shard: nothing is returned whose bytes were not checked.

Of every member that is read, the header must be the canonical one, the padding zero, and the payload must
hash to what the index says; the index must hash to what `dataset.json` says of it, and the tar must have the
size that stands there. With a shard's last sample the end of the tar is checked too. So whoever reads all
members of all samples notices any cut and any flipped bit; members that are not asked for are not looked at.

SHA-256 costs about 0.5 ms a megabyte, that is 1 ms for the 2 MB of a 256^3 histogram.

>>> info = load_dataset(url)                                                        # doctest: +SKIP
>>> for split, entry in info.shards():                                              # doctest: +SKIP
...     with ShardReader(Store(url), split, entry) as shard:
...         for sample, members in shard.samples(["json", "target-64.oct"]):
...             ...

`TarReader` is the one way to read a tar out of order: `ShardReader`, the loader and every tool go through it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cached_property
from types import TracebackType
from typing import IO, Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.shards.dataset import ShardEntry
from ocnf_data.shards.faults import RawMember, end_faults, member_faults
from ocnf_data.shards.index import Member, SampleEntry, ShardIndex, shard_path
from ocnf_data.shards.index_files import check_size, load_index
from ocnf_data.shards.tarformat import BLOCK, TRAILER, padding

_REMOTE_GAP = 512 * 2**10  # bytes that are cheaper to fetch than a second request
_ReadRange = Callable[[int, int], bytes]
# The bytes from a start to an end; fewer where the tar ends, which the checks tell with key and member.


class TarReader:
    """Random access to the members of one tar, each of them checked; picklable (the file is reopened).

    Reading is by offset. Locally the file stays open; over a network, members that lie next to each other, or
    have little between them, come in one request.

    Args:
        store: the data set's folder.
        path: `train/shard-000000.tar`.
        size: bytes that the tar must have; compared before the first read.

    Attributes:
        where: the tar's full path or URL.
    """

    def __init__(self, store: Store, path: str, size: int) -> None:
        self._store, self._path, self._size = store, path, size
        self._checked = False
        self._file: IO[bytes] | None = None
        self.where = store.where(path)

    def read(self, key: str, members: Sequence[Member], closes: bool = False) -> list[bytes]:
        """Payloads of members of one sample.

        Args:
            key: the sample's.
            members: where they lie and what they must hash to.
            closes: whether the sample is the tar's last: then the last blocks are checked too.

        Raises:
            OcnfError: code `missing`, `truncated`, `size`, `header`, `checksum`, `padding` or `trailer`,
                naming the tar, the key, the member and the byte offset.
        """
        if not self._checked:
            check_size(self._store, self._path, self._size)
            self._checked = True
        trailer = (self._size - len(TRAILER), self._size)
        extents = [_extent(member) for member in members] + ([trailer] if closes else [])
        payloads = []
        with storage_errors(self.where):
            read = self._local() if self._store.is_local else self._remote(extents)
            for member in members:
                start, end = _extent(member)
                payload_end = member.offset + member.size
                raw = RawMember(read(start, member.offset), read(member.offset, payload_end),
                                read(payload_end, end))
                for fault in member_faults(key, member, raw):
                    raise fault.error(self.where)
                payloads.append(raw.payload)
            if closes:
                for fault in end_faults(read(trailer[0], trailer[1] + 1), self._size):
                    raise fault.error(self.where)
        return payloads

    def close(self) -> None:
        """Close the file; the next read opens it again."""
        if self._file is not None:
            self._file.close()
        self._file, self._checked = None, False

    def _local(self) -> _ReadRange:
        file = self._file = self._file or self._store.open(self._path)

        def read(start: int, end: int) -> bytes:
            file.seek(start)
            return file.read(end - start)

        return read

    def _remote(self, extents: list[tuple[int, int]]) -> _ReadRange:
        pieces = {start: memoryview(self._store.read_range(self._path, start, end - start))
                  for start, end in _merge(extents, _REMOTE_GAP)}

        def read(start: int, end: int) -> bytes:
            base = max(first for first in pieces if first <= start)
            return bytes(pieces[base][start - base : end - base])

        return read

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None, "_checked": False}


class ShardReader:
    """One shard of a data set, open for reading; a context manager, and picklable (the file is reopened).

    Args:
        store: the data set's folder.
        split: the split's name.
        entry: what `dataset.json` says of the shard.

    Every method raises OcnfError with the code `missing`, `truncated`, `size`, `header`, `checksum`,
    `padding` or `trailer`, naming the shard, the key, the member and the byte offset.
    """

    def __init__(self, store: Store, split: str, entry: ShardEntry) -> None:
        self.store, self.split, self.entry = store, split, entry
        self.path = shard_path(split, entry.shard)
        self._tar = TarReader(store, self.path, entry.size)

    @cached_property
    def index(self) -> ShardIndex:
        """The shard's index, checked against `dataset.json`; made again from the tar if it is lost."""
        return load_index(self.store, self.split, self.entry)

    def __len__(self) -> int:
        return self.entry.samples

    def read(self, position: int, members: Collection[str] | None = None) -> dict[str, bytes]:
        """Payloads of one sample by member name, in the order asked for.

        Args:
            position: the sample's number in the shard, from 0.
            members: the members to read; None is all. Only these are checked.
        """
        sample = self.index.samples[position]
        wanted = sample.members if members is None else [self._member(sample, name) for name in members]
        payloads = self._tar.read(sample.key, wanted, closes=sample is self.index.samples[-1])
        return {member.name: payload for member, payload in zip(wanted, payloads, strict=True)}

    def samples(
        self, members: Collection[str] | None = None
    ) -> Iterator[tuple[SampleEntry, dict[str, bytes]]]:
        """(entry, payloads) of all samples in the order of the tar, one in memory at a time."""
        for position, sample in enumerate(self.index.samples):
            yield sample, self.read(position, members)
        if not self.index.samples:
            self._tar.read("", (), closes=True)

    def close(self) -> None:
        """Close the file; the next read opens it again."""
        self._tar.close()

    def __enter__(self) -> ShardReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def _member(self, sample: SampleEntry, name: str) -> Member:
        try:
            return sample.member(name)
        except OcnfError as error:
            raise OcnfError(error.what, code=error.code, where=self.store.where(self.path),
                            field=f"{sample.key}.{name}", expected=error.expected) from None


def _extent(member: Member) -> tuple[int, int]:
    """First byte of the header, and the byte after the padding."""
    end = member.offset + member.size
    return member.offset - BLOCK, end + padding(end)


def _merge(ranges: Sequence[tuple[int, int]], gap: int) -> Iterator[tuple[int, int]]:
    """Ranges (start, end) joined where at most `gap` bytes lie between them."""
    if not ranges:
        return
    ordered = sorted(ranges)
    start, end = ordered[0]
    for next_start, next_end in ordered[1:]:
        if next_start - end > gap:
            yield start, end
            start = next_start
        end = next_end
    yield start, end
