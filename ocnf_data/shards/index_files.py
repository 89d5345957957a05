"""The index of a shard as it lies in the data set; a lost one is made again from the tar."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import sha256_hex
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.shards.dataset import ShardEntry
from ocnf_data.shards.index import MAX_INDEX_BYTES, ShardIndex, index_path, shard_path
from ocnf_data.shards.walk import index_from_tar

_READERS = 16  # indices read at a time: over a network it is the latency that counts
_AHEAD = 4 * _READERS  # read and not yet taken; an index in memory is about ten times its file


def read_index(store: Store, split: str, shard: str, sha256: str | None = None) -> ShardIndex:
    """The index beside a tar, checked by itself.

    Args:
        store: the data set's folder.
        split: the split's name.
        shard: `shard-000000.tar`.
        sha256: what the file must hash to; None where nothing says so.

    Raises:
        OcnfError: code `missing`, `too_large`, `checksum` (not the file of that hash), `misplaced` (the index
            of another shard), or what `ShardIndex.from_json` raises.
    """
    name = index_path(split, shard)
    where = store.where(name)
    blob = store.read_at_most(name, MAX_INDEX_BYTES)
    if sha256 is not None and sha256_hex(blob) != sha256:
        raise OcnfError("the index is not the one that dataset.json lists", code="checksum",
                        where=where, fix="`ocnf-data repair` makes it again from the shard")
    index = ShardIndex.from_json(blob, where)
    if (index.split, index.shard) != (split, shard):
        raise OcnfError(f"the index of {index.split}/{index.shard}", code="misplaced", where=where,
                        expected=shard_path(split, shard))
    return index


def load_index(store: Store, split: str, entry: ShardEntry) -> ShardIndex:
    """The index of a shard, if it is the one that `dataset.json` lists; a lost one is made again.

    Raises:
        OcnfError: code `checksum` for a damaged index, or what `rebuild_index` raises.
    """
    try:
        index = read_index(store, split, entry.shard, entry.index_sha256)
    except OcnfError as error:
        if error.code != "missing":
            raise
        return rebuild_index(store, split, entry)
    _check_entry(index, split, entry, store.where(index_path(split, entry.shard)))
    return index


def load_indices(store: Store, shards: Iterable[tuple[str, ShardEntry]]) -> Iterator[ShardIndex]:
    """`load_index` of every (split, entry), in this order; over a network several at a time."""
    if store.is_local:  # parsing takes most of the time, and threads do not share it
        yield from (load_index(store, split, entry) for split, entry in shards)
        return
    ahead: deque[Future[ShardIndex]] = deque()
    with ThreadPoolExecutor(_READERS) as pool:
        try:
            for split, entry in shards:
                ahead.append(pool.submit(load_index, store, split, entry))
                if len(ahead) >= _AHEAD:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            for future in ahead:
                future.cancel()


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


def check_size(store: Store, name: str, size: int) -> None:
    """Refuse a file that is missing or has another size: most cuts show here, before anything is read."""
    found = store.size(name)
    if found != size:
        raise OcnfError("the file has another size", code="truncated" if found < size else "size",
                        where=store.where(name), found=f"{found} bytes", expected=size)


def _check_entry(index: ShardIndex, split: str, entry: ShardEntry, where: object) -> None:
    if index.split != split or ShardEntry.of(index) != entry:
        raise OcnfError("the shard is not the one that dataset.json lists", code="checksum",
                        where=where, found=f"{index.split}/{index.shard}, SHA-256 {index.sha256[:16]}...",
                        expected=f"{split}/{entry.shard}, SHA-256 {entry.sha256[:16]}...")
