"""Writing a shard: its tar and then its index, each under its final name only when whole.

>>> with ShardWriter(Store(out), "train", 0) as writer:                           # doctest: +SKIP
...     for sample in samples:
...         writer.add(sample.key, sample.members, timings={"render": 0.4})
>>> writer.entry                                    # what dataset.json says of this shard  # doctest: +SKIP

Where the block raises, nothing is published and no temporary stays. A killed process leaves at most a
`.tmp-*` file, or a tar without its index, which is not `find_complete` and gets written again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from types import TracebackType
from typing import IO

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.files.storage import Store
from ocnf_data.shards.dataset import ShardEntry
from ocnf_data.shards.index import (
    MAX_SAMPLES,
    SampleEntry,
    ShardIndex,
    check_split,
    index_path,
    make_entry,
    shard_name,
    shard_path,
)
from ocnf_data.shards.index_files import read_index
from ocnf_data.shards.tarformat import JSON, TRAILER, make_header, padding

# What an index may be wrong in, where its shard was being written when the process was killed.
_NOT_DONE = frozenset({"missing", "too_large", "invalid", "checksum", "schema", "misplaced"})


class ShardWriter:
    """Context manager that writes shard `number` of a split; see the module's example.

    Args:
        store: the data set's folder.
        split: `train`, `val`, `test` or another name of a-z, 0-9 and _.
        number: the shard's number, from 0.
    """

    def __init__(self, store: Store, split: str, number: int) -> None:
        self.store = store
        self.split = check_split(split)
        self.shard = shard_name(number)
        self._index: ShardIndex | None = None
        self._samples: list[SampleEntry] = []
        self._keys: set[str] = set()
        self._timings: dict[str, dict[str, float]] = {}
        self._digest = hashlib.sha256()
        self._size = 0
        self._file: IO[bytes] | None = None
        self._publication: AbstractContextManager[None] | None = None

    @property
    def index(self) -> ShardIndex:
        """The shard's index; there once the block has ended, before that OcnfError."""
        if self._index is None:
            raise OcnfError("the shard is not finished", where=shard_path(self.split, self.shard))
        return self._index

    @property
    def entry(self) -> ShardEntry:
        """What `dataset.json` says of the shard; there once the block has ended, before that OcnfError."""
        return ShardEntry.of(self.index)

    def add(self, key: str, members: Mapping[str, bytes], timings: Mapping[str, float] | None = None) -> None:
        """Append a sample.

        Args:
            key: 1 to 64 of `A-Z a-z 0-9 _ -`, new in this shard.
            members: payload by member name (`tarformat.check_member`), in the order to be written. First
                `json`, an object that has at least `key`, `category`, `source` and `leaf_counts`
                (`{"target-64.oct": 25117, ...}`, one for each octree member); then the octrees.
            timings: seconds by stage, kept in `timings/` and out of all checksums.

        Raises:
            OcnfError: a name, size or json that the format does not allow; nothing of it is written then.
        """
        if key in self._keys or len(self._samples) >= MAX_SAMPLES:
            raise OcnfError("the shard has a sample of this key already, or is full", code="layout",
                            where=shard_path(self.split, self.shard), found=key)
        hashes = {name: (len(payload), sha256_hex(payload)) for name, payload in members.items()}
        entry = make_entry(key, hashes, members.get(JSON, b""), self._size)
        for name, payload in members.items():
            self._write(make_header(key, name, len(payload)))
            self._write(payload)
            self._write(bytes(padding(len(payload))))
        self._samples.append(entry)
        self._keys.add(key)
        if timings:
            self._timings[key] = dict(timings)

    def __enter__(self) -> ShardWriter:
        self._publication = self._publishing()
        self._publication.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> bool | None:
        assert self._publication is not None
        return self._publication.__exit__(kind, error, trace)

    @contextmanager
    def _publishing(self) -> Iterator[None]:
        tar, index = shard_path(self.split, self.shard), index_path(self.split, self.shard)
        with self.store.writing(tar) as path:
            with path.open("wb") as file:
                self._file = file
                yield
                self._write(TRAILER)
                self._file = None
            self._index = ShardIndex(split=self.split, shard=self.shard, size=self._size,
                                     sha256=self._digest.hexdigest(), samples=tuple(self._samples))
            self.store.remove(index)  # the index of an earlier shard must not be taken for this one's
        if self._timings:
            timings = canonical_json(self._timings, indent=1)
            self.store.put_bytes(timings_path(self.split, self.shard), timings)
        self.store.put_bytes(index, self._index.to_json())

    def _write(self, data: bytes) -> None:
        if self._file is None:
            raise OcnfError("samples are added inside `with ShardWriter(...)`", where=self.shard)
        self._file.write(data)
        self._digest.update(data)
        self._size += len(data)


def timings_path(split: str, shard: str) -> str:
    """`timings/train-000007.json`: outside the splits, because no checksum covers it."""
    return f"timings/{split}-{shard.removeprefix('shard-').removesuffix('.tar')}.json"


def find_complete(store: Store, split: str, number: int, check_sha256: bool = False) -> ShardIndex | None:
    """The index of a shard that is done: it is there, whole, and fits the tar. None otherwise.

    Args:
        store: the data set's folder.
        split: the split's name.
        number: the shard's number.
        check_sha256: read the whole tar and compare its SHA-256 too, not only its size.
    """
    shard = shard_name(number)
    tar = shard_path(split, shard)
    try:
        index = read_index(store, split, shard)
    except OcnfError as error:
        if error.code in _NOT_DONE:
            return None
        raise
    if not store.exists(tar) or index.size != store.size(tar):
        return None
    if check_sha256 and file_sha256(store, tar) != index.sha256:
        return None
    return index


def file_sha256(store: Store, name: str) -> str:
    """SHA-256 of a file, read in pieces."""
    with store.open(name) as file:
        digest = hashlib.sha256()
        while piece := file.read(2**20):
            digest.update(piece)
    return digest.hexdigest()
