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
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import cached_property
from types import TracebackType
from typing import IO, Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import sha256_hex
from ocnf_data.files.storage import Store, storage_errors
from ocnf_data.shards.dataset import ShardEntry
from ocnf_data.shards.faults import end_faults, member_faults, read_member
from ocnf_data.shards.index import (
    MAX_INDEX_BYTES,
    Member,
    SampleEntry,
    ShardIndex,
    index_from_tar,
    index_path,
    shard_path,
)
from ocnf_data.shards.tarformat import BLOCK, TRAILER


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
        self._file: IO[bytes] | None = None

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
        payloads = {member.name: self._read_member(sample, member) for member in wanted}
        if sample is self.index.samples[-1]:
            self._check_end()
        return payloads

    def samples(
        self, members: Collection[str] | None = None
    ) -> Iterator[tuple[SampleEntry, dict[str, bytes]]]:
        """(entry, payloads) of all samples in the order of the tar, one in memory at a time."""
        for position, sample in enumerate(self.index.samples):
            yield sample, self.read(position, members)
        if not self.index.samples:
            self._check_end()

    def close(self) -> None:
        """Close the file; the next read opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> ShardReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_file": None}

    def _open(self) -> IO[bytes]:
        if self._file is None:
            check_size(self.store, self.path, self.entry.size)
            self._file = self.store.open(self.path)
        return self._file

    def _member(self, sample: SampleEntry, name: str) -> Member:
        try:
            return sample.member(name)
        except OcnfError as error:
            raise OcnfError(error.what, code=error.code, where=self.store.where(self.path),
                            field=f"{sample.key}.{name}", expected=error.expected) from None

    def _read_member(self, sample: SampleEntry, member: Member) -> bytes:
        where = self.store.where(self.path)
        with storage_errors(where):
            file = self._open()
            file.seek(member.offset - BLOCK)
            header, payload, pad = read_member(file, member)
        for fault in member_faults(sample.key, member, header, payload, pad):
            raise fault.error(where)
        return payload

    def _check_end(self) -> None:
        where = self.store.where(self.path)
        with storage_errors(where):
            file = self._open()
            file.seek(self.entry.size - len(TRAILER))
            end = file.read(len(TRAILER) + 1)
        for fault in end_faults(end, self.entry.size):
            raise fault.error(where)


def check_size(store: Store, name: str, size: int) -> None:
    """Refuse a file that is missing or has another size: most cuts show here, before anything is read."""
    found = store.size(name)
    if found != size:
        raise OcnfError("the file has another size", code="truncated" if found < size else "size",
                        where=store.where(name), found=f"{found} bytes", expected=size)


def load_index(store: Store, split: str, entry: ShardEntry) -> ShardIndex:
    """The index of a shard, if it is the one that `dataset.json` lists; a lost one is made again.

    Raises:
        OcnfError: code `checksum` for a damaged index, or what `rebuild_index` raises.
    """
    name = index_path(split, entry.shard)
    if not store.exists(name):
        return rebuild_index(store, split, entry)
    where = store.where(name)
    if store.size(name) > MAX_INDEX_BYTES:
        raise OcnfError("the index is too large", code="too_large", where=where)
    blob = store.read_bytes(name)
    if sha256_hex(blob) != entry.index_sha256:
        raise OcnfError("the index is not the one that dataset.json lists", code="checksum",
                        where=where, fix="`ocnf-data repair` makes it again from the shard")
    index = ShardIndex.from_json(blob, where)
    _check_entry(index, split, entry, where)
    return index


def rebuild_index(store: Store, split: str, entry: ShardEntry) -> ShardIndex:
    """The index of a shard, from its tar alone; only if the tar is the one that `dataset.json` lists.

    Raises:
        OcnfError: the tar is damaged (the message has the byte offset), or it is another one (`checksum`).
    """
    path = shard_path(split, entry.shard)
    where = store.where(path)
    check_size(store, path, entry.size)
    with store.open(path) as file, storage_errors(where):
        index = index_from_tar(file, split, entry.shard, where)
    _check_entry(index, split, entry, where)
    return index


def _check_entry(index: ShardIndex, split: str, entry: ShardEntry, where: object) -> None:
    if index.split != split or ShardEntry.of(index) != entry:
        raise OcnfError("the shard is not the one that dataset.json lists", code="checksum",
                        where=where, found=f"{index.split}/{index.shard}, SHA-256 {index.sha256[:16]}...",
                        expected=f"{split}/{entry.shard}, SHA-256 {entry.sha256[:16]}...")
