"""The unit of work: one worker makes all samples of one shard and writes it to its place.

Failures travel with the shard: `failures/train-000007.jsonl` is written before the shard's index, so that a
shard that is done accounts for every item it was planned with, and a killed run forgets nothing.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import astuple, dataclass

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_data.generation.progress import LiveCount
from ocnf_data.generation.records import Failure, Item, Sample, ShardPlan
from ocnf_data.generation.worker.supervisor import ChildLimits, ChildSetup, supervisor_of_this_thread
from ocnf_data.shards.catalogue import ShardContents
from ocnf_data.shards.dataset import ShardEntry
from ocnf_data.shards.index import index_path
from ocnf_data.shards.writer import ShardWriter, find_complete

_MAX_FAILURES = 256 * 2**20  # bytes of one shard's failure rows


@dataclass(frozen=True)
class ShardTask:
    """What a worker is told: plain values, so that any backend can send them anywhere.

    Attributes:
        out: the data set's URL, as the worker reaches it.
        shard: the shard and its items.
        setup, limits: what the child process that runs the items is started with.
        live: a folder to count finished items in, for the progress bar; None where the driver sees none.
    """

    out: str
    shard: ShardPlan
    setup: ChildSetup
    limits: ChildLimits
    live: str | None = None


@dataclass(frozen=True)
class ShardDone:
    """A shard that is in its place, with its index: what the driver needs of it.

    Attributes:
        name: `train-000007`.
        entry: what `dataset.json` is to say of it.
        contents: what the split's catalogue is to say of it.
        failures: the items of this shard that failed.
    """

    name: str
    entry: ShardEntry
    contents: ShardContents
    failures: tuple[Failure, ...]


def make_shard(task: ShardTask) -> ShardDone:
    """Make and publish a shard.

    Raises:
        OcnfError: the shard cannot be written, or the machine is at fault; nothing is published then.
    """
    store, shard = Store(task.out), task.shard
    supervisor = supervisor_of_this_thread(task.setup, task.limits)
    failures: list[Failure] = []
    with LiveCount(task.live, shard.name) as live, ShardWriter(store, shard.split, shard.number) as writer:
        for item in shard.items:
            failure = _add(writer, item, supervisor.run(item))
            if failure is not None:
                failures.append(failure)
            live.count(failed=failure is not None)
        _put_failures(store, shard, failures)
    return ShardDone(shard.name, writer.entry, ShardContents.of(writer.index), tuple(failures))


def find_done(store: Store, shard: ShardPlan, names: Collection[str],
              check_sha256: bool = False) -> ShardDone | None:
    """The shard, if it is done: whole, and every planned item is in it or has a failure row. None otherwise.

    Args:
        store: the data set.
        shard: the planned shard.
        names: all files of the data set (`store.list()`), so that looking costs one listing for all shards.
        check_sha256: read the tar, too.
    """
    index_name = index_path(shard.split, f"shard-{shard.number:06d}.tar")
    if index_name not in names:
        return None
    index = find_complete(store, shard.split, shard.number, check_sha256)
    failures = _read_failures(store, shard) if failures_path(shard) in names else []
    if index is None or failures is None:
        return None
    accounted = [sample.key for sample in index.samples] + [failure.item for failure in failures]
    if sorted(accounted) != sorted(item.key for item in shard.items):
        return None
    return ShardDone(shard.name, ShardEntry.of(index), ShardContents.of(index), tuple(failures))


def failures_path(shard: ShardPlan) -> str:
    """`failures/train-000007.jsonl`, there only if the shard has failures."""
    return f"failures/{shard.name}.jsonl"


def jsonl(failures: Sequence[Failure]) -> bytes:
    """Failures as JSON lines."""
    return b"".join(canonical_json(failure.to_json()) for failure in failures)


def _add(writer: ShardWriter, item: Item, result: Sample | Failure) -> Failure | None:
    if isinstance(result, Failure):
        return result
    try:
        writer.add(result.key, result.members, result.timings)
    except OcnfError as error:  # a member over the format's limits; failures of the disk are OSErrors in here
        return Failure.of(item, "write", error.code, str(error))
    return None


def _put_failures(store: Store, shard: ShardPlan, failures: Sequence[Failure]) -> None:
    if failures:
        store.put_bytes(failures_path(shard), jsonl(failures))
    else:
        store.remove(failures_path(shard))  # of an earlier try


def _read_failures(store: Store, shard: ShardPlan) -> list[Failure] | None:
    """The rows of a shard's failures; None where they are not as they were written."""
    try:
        data = store.read_at_most(failures_path(shard), _MAX_FAILURES)
    except OcnfError as error:
        if error.code not in ("missing", "too_large"):  # says nothing about the bytes
            raise
        return None
    try:
        rows = [Failure.from_json(json.loads(line)) for line in data.splitlines()]
        whole = jsonl(rows) == data and all(isinstance(value, str) for row in rows for value in astuple(row))
    except (KeyError, RecursionError, TypeError, ValueError):
        return None
    return rows if whole else None
