"""The account of a run: which shards are done, and the files that say so, `dataset.json` the last of them.

It follows from `plan.json`, the shards' indices and their rows of failures alone, and can so be made again.
"""

from __future__ import annotations

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.generation.plan import Plan
from ocnf_data.generation.records import Failure
from ocnf_data.generation.shard_task import ShardDone, failures_path, find_done, jsonl
from ocnf_data.shards.catalogue import SplitCatalogue
from ocnf_data.shards.dataset import (
    FAILURES,
    PLAN,
    Counts,
    DatasetInfo,
    FileEntry,
    write_dataset,
)
from ocnf_data.shards.index import catalogue_path
from ocnf_data.shards.writer import file_sha256


def done_before(store: Store, plan: Plan, listed: DatasetInfo | None = None, *, retry_failed: bool = False,
                check_sha256: bool = False) -> dict[str, ShardDone]:
    """The shards of a plan that are done, by name.

    Args:
        store: the data set's folder.
        plan: what is to be there.
        listed: what `dataset.json` says, where there is one: a shard whose failures are others is not done.
        retry_failed: shards with failures do not count as done.
        check_sha256: read the tars, too: to be asked for where nothing else says what they must be.
    """
    names = {name for folder in (*plan.splits, "failures") for name in store.list(folder)}
    done = {}
    for shard in plan.shards:
        one = find_done(store, shard, names, check_sha256)
        if one is None or (retry_failed and one.failures):
            continue
        entry = None if listed is None else listed.file(failures_path(shard))
        if entry is None or entry == FileEntry.of(entry.name, jsonl(one.failures)):
            done[one.name] = one
    return done


def failure_rows(plan: Plan, done: dict[str, ShardDone]) -> tuple[tuple[Failure, ...], bytes]:
    """The failures of all shards, and `failures.jsonl`, which has the exclusions too."""
    failures = tuple(failure for shard in plan.shards for failure in done[shard.name].failures)
    return failures, jsonl([*failures, *plan.exclusions])


def finish(store: Store, plan: Plan, name: str, done: dict[str, ShardDone],
           before: DatasetInfo | None = None) -> tuple[DatasetInfo, tuple[Failure, ...]]:
    """Write `failures.jsonl`, the catalogues and `dataset.json` of a data set whose shards are all done.

    Args:
        store: the data set's folder.
        plan: the plan in it.
        name: the manifest's.
        done: every shard of the plan, by name.
        before: what `dataset.json` says, where there is one.

    Returns:
        What `dataset.json` says now, and the failures.

    Raises:
        OcnfError: code `changed` where `before` lists another shard; nothing is written then.
    """
    info, failures, files = _account(store, plan, name, done)
    if before is not None:
        _compare(before, info, store)
    for file, data in files.items():
        if not store.holds(file, data):
            store.put_bytes(file, data)
    write_dataset(store, info)
    return info, failures


def _account(store: Store, plan: Plan, name: str, done: dict[str, ShardDone]
             ) -> tuple[DatasetInfo, tuple[Failure, ...], dict[str, bytes]]:
    """What `dataset.json` is to say; the failures; and the files to be written before it, by name."""
    in_order = [(shard, done[shard.name]) for shard in plan.shards]
    failures, rows = failure_rows(plan, done)
    catalogues = {}
    for split in plan.splits:
        contents = (one.contents for shard, one in in_order if shard.split == split)
        catalogues[catalogue_path(split)] = SplitCatalogue.of(split, contents).to_bytes()
    files = [FileEntry(name=PLAN, size=store.size(PLAN), sha256=file_sha256(store, PLAN)),
             FileEntry.of(FAILURES, rows),
             *(FileEntry.of(failures_path(shard), jsonl(one.failures))
               for shard, one in in_order if one.failures),
             *(FileEntry.of(file, data) for file, data in catalogues.items())]
    samples = sum(one.entry.samples for _, one in in_order)
    counts = Counts(items=len(plan.items) + len(plan.exclusions), samples=samples, failures=len(failures),
                    exclusions=len(plan.exclusions))
    splits = {split: tuple(one.entry for shard, one in in_order if shard.split == split)
              for split in plan.splits}
    info = DatasetInfo(name=name, manifest=plan.manifest, fingerprint=plan.fingerprint,
                       counts=counts, splits=splits, files=tuple(files))
    return info, failures, {FAILURES: rows, **catalogues}


def _compare(before: DatasetInfo, now: DatasetInfo, store: Store) -> None:
    """A finished data set that was repaired must be the one that `dataset.json` lists."""
    listed = {(split, entry.shard): entry.sha256 for split, entry in before.shards()}
    for split, entry in now.shards():
        if listed.get((split, entry.shard)) != entry.sha256:
            raise OcnfError("the shard, made again, is not the one that dataset.json lists",
                            code="changed", where=store.where(f"{split}/{entry.shard}"), found=entry.sha256,
                            expected=f"sha256 {listed.get((split, entry.shard), 'none')}",
                            fix="if an item failed this time, --retry-failed makes its shard once more")
