"""Verifying a data set: every byte, every count, every octree; one row for each thing that is wrong.

`verify` does not stop at the first problem, nor at a damaged shard, nor at a missing `dataset.json`. A data
set passes when there is no problem; a stray file is a note only, where no reader would take it for data.
"""

from __future__ import annotations

import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeAlias

from ocnf_data.errors import OcnfError
from ocnf_data.files.interrupts import ignore_interrupts, starting_processes
from ocnf_data.files.storage import Store
from ocnf_data.shards.catalogue import ShardContents, SplitCatalogue, stored_catalogue
from ocnf_data.shards.dataset import DATASET, FAILURES, PLAN, DatasetInfo, ShardEntry, load_dataset
from ocnf_data.shards.index import catalogue_path, index_path, is_shard, shard_path
from ocnf_data.shards.writer import file_sha256
from ocnf_data.verify.account import check_account
from ocnf_data.verify.check import ShardReport, check_shard
from ocnf_data.verify.problems import VerifyReport

_FREE = (".", "failures/", "quarantine/", "timings/", "views/")
_Shard: TypeAlias = tuple[str, str, ShardEntry | None]  # split, shard, what dataset.json says of it


def verify(
    url: str | Store, jobs: int = 1, progress: Callable[[int, int], None] | None = None
) -> VerifyReport:
    """Check everything in a data set.

    Args:
        url: folder or fsspec URL.
        jobs: processes to share the shards among.
        progress: called with (shards done, shards in all).
    """
    store = url if isinstance(url, Store) else Store(url)
    report = VerifyReport(store.url)
    names = store.list()
    report.info = _load_info(store, report)
    shards = _expected_shards(report.info, names)
    report.shards = len(shards)
    keys: Counter[str] = Counter()
    contents: dict[str, ShardContents | None] = {}
    for done, part in enumerate(_check_shards(store, shards, jobs), start=1):
        report.problems += part.problems
        report.samples += len(part.keys)
        report.members += part.members
        report.size += part.size
        keys.update(part.keys)
        contents[part.path] = part.contents
        if progress is not None:
            progress(done, len(shards))
    for key, count in keys.items():
        if count > 1:
            report.add(DATASET, "duplicate", f"{count} samples have this key", key)
    _check_files(store, report, names, shards)
    _check_catalogues(store, report, contents)
    check_account(store, report, names, set(keys))
    report.problems.sort(key=lambda problem: (problem.file, problem.offset or 0, problem.key or ""))
    return report


def _load_info(store: Store, report: VerifyReport) -> DatasetInfo | None:
    try:
        return load_dataset(store)
    except OcnfError as error:
        report.add(DATASET, error.code, str(error))
        return None


def _expected_shards(info: DatasetInfo | None, names: Iterable[str]) -> list[_Shard]:
    """The shards that should be there; without a `dataset.json`, those that are."""
    if info is not None:
        return [(split, entry.shard, entry) for split, entry in info.shards()]
    found = (name.partition("/") for name in names if is_shard(name))
    return [(split, shard, None) for split, _, shard in found]


def _check_shards(store: Store, shards: list[_Shard], jobs: int) -> Iterator[ShardReport]:
    if jobs <= 1 or len(shards) <= 1 or not store.shared_between_processes:
        yield from (check_shard(store, *shard) for shard in shards)
        return
    # spawn: a forked child would inherit the locks of numba's and of fsspec's threads
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(shards)), context, ignore_interrupts) as pool:
        try:
            with starting_processes():
                futures = [pool.submit(check_shard, store, *shard) for shard in shards]
            for future in as_completed(futures):
                yield future.result()
        except BaseException:  # Ctrl-C: nobody waits for what they are at
            for process in multiprocessing.active_children():
                process.kill()
            raise


def _check_files(store: Store, report: VerifyReport, names: list[str], shards: list[_Shard]) -> None:
    """The files beside the shards: those that dataset.json lists are whole; others are named."""
    expected = {DATASET, PLAN, FAILURES}
    for split, shard, _ in shards:
        expected |= {shard_path(split, shard), index_path(split, shard)}
    for entry in report.info.files if report.info is not None else ():
        expected.add(entry.name)
        if not store.exists(entry.name):
            report.add(entry.name, "missing", "the file is not there")
        elif store.size(entry.name) != entry.size or file_sha256(store, entry.name) != entry.sha256:
            report.add(entry.name, "sha256", "not the file that dataset.json lists")
    splits = {split for split, _, _ in shards}
    if report.info is None:  # unfinished: dataset.json, which lists them, comes after them
        expected |= {catalogue_path(split) for split in splits}
    for name in names:
        if name in expected or name.startswith(_FREE):
            continue
        if name.partition("/")[0] in splits or is_shard(name):  # a reader of *.tar would take it for data
            report.add(name, "extra", "dataset.json does not list this file")
        else:
            report.notes.append(f"{name} is no part of the data set")


def _check_catalogues(store: Store, report: VerifyReport,
                      contents: dict[str, ShardContents | None]) -> None:
    """Every catalogue that is whole says what the indices say; others are reported with the files."""
    info = report.info
    if info is None:
        return
    for split, entries in info.splits.items():
        name = catalogue_path(split)
        shards = [contents[shard_path(split, entry.shard)] for entry in entries]
        try:
            stored = stored_catalogue(store, info, split) if store.exists(name) else None
        except OcnfError as error:
            if error.code != "checksum":  # that one is found by its SHA-256 already
                report.add(name, error.code, str(error))
            continue
        known = [shard for shard in shards if shard is not None]
        if stored is None or len(known) < len(shards):
            continue
        if stored.to_bytes() != SplitCatalogue.of(split, known).to_bytes():
            report.add(name, "catalogue", "says other things than the indices")
