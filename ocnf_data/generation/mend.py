"""`ocnf-data repair`: what is damaged is set aside and made again, from what is whole.

    dataset.json     from the plan, the indices and the rows of failures, if every shard is done
    an index         from its tar
    a shard          from the meshes, and so its rows of failures
    failures.jsonl   from the shards' rows, and a catalogue from the indices
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.files.lock import exclusive
from ocnf_data.files.storage import Store
from ocnf_data.generation import generate
from ocnf_data.generation.account import done_before, failure_rows, finish
from ocnf_data.generation.plan import make_plan
from ocnf_data.generation.resume import adopt, read_plan
from ocnf_data.generation.shard_task import failures_path
from ocnf_data.manifest import Manifest
from ocnf_data.shards.dataset import DATASET, FAILURES, DatasetInfo, FileEntry, find_dataset, load_dataset
from ocnf_data.shards.index import is_shard, shard_name, shard_path
from ocnf_data.verify.problems import Problem, VerifyReport
from ocnf_data.verify.repair import (
    damaged_shards,
    quarantine,
    restore_catalogues,
    restore_index,
    set_aside,
)


def mend(url: str, meshes: str | os.PathLike[str] | None, jobs: int, look: Callable[[], VerifyReport],
         console: Console) -> list[Problem]:
    """Repair a finished data set.

    Args:
        url: folder or fsspec URL.
        meshes: the folder that the manifest's paths are relative to; needed only to make shards again.
        jobs: worker processes.
        look: verifies the data set.
        console: where to say what is done.

    Returns:
        What is wrong still.

    Raises:
        OcnfError: there is no finished data set, or shards cannot be made again: nothing is set aside then.
    """
    store = Store(url)
    if find_dataset(store) is None:
        _restore_dataset(store, meshes, jobs, console)
    info = load_dataset(store)
    report = look()
    if not (damaged := damaged_shards(report)):
        console.print("[green]no shard is damaged[/]")
    lost: list[str] = []
    for shard in damaged:
        _say(console, f"{shard.path}: {shard.problems[0].what}")
        if restore_index(store, shard.split, shard.shard):
            _say(console, "  the tar is whole, its index was written again")
        else:
            lost.append(shard.path)
    lost += _restore_failures(store, info, report, console, all_shards=not lost)
    if lost:
        _make_again(store, Manifest.from_dict(info.manifest), tuple(info.splits), meshes, jobs, lost, console)
    else:
        for name in restore_catalogues(store):
            _say(console, f"{name} was written again from the indices")
    return [] if report.ok else look().problems


def _restore_dataset(store: Store, meshes: str | os.PathLike[str] | None, jobs: int,
                     console: Console) -> None:
    """Write a damaged `dataset.json` again. It said what the tars must be, so they are read."""
    plan = read_plan(store)
    manifest = Manifest.from_dict(plan.manifest)
    done = done_before(store, plan, check_sha256=True)
    lost = [name for shard in plan.shards if shard.name not in done
            for name in (shard_path(shard.split, shard_name(shard.number)), failures_path(shard))]
    if lost:
        _make_again(store, manifest, plan.splits, meshes, jobs, [*lost, DATASET], console)
        return
    with exclusive(store):
        _set_aside(store, [DATASET], console)
        finish(store, plan, manifest.name, done)
    _say(console, f"{DATASET} was damaged, and was written again from plan.json and the shards")


def _restore_failures(store: Store, info: DatasetInfo, report: VerifyReport, console: Console,
                      all_shards: bool) -> list[str]:
    """Write `failures.jsonl` again; returns the rows of shards that must be made again for them."""
    files = {problem.file for problem in report.problems}
    if FAILURES not in files and not any(name.startswith("failures/") for name in files):
        return []
    try:
        plan = read_plan(store)
    except OcnfError:  # which `verify` has said, too
        return []
    done = done_before(store, plan, info)
    lost = [failures_path(shard) for shard in plan.shards if shard.name not in done]
    if lost or not all_shards:
        return lost
    rows = failure_rows(plan, done)[1]
    if FAILURES in files and info.file(FAILURES) == FileEntry.of(FAILURES, rows):
        _set_aside(store, [FAILURES], console)
        store.put_bytes(FAILURES, rows)
        _say(console, f"{FAILURES} was written again from the shards' rows")
    return []


def _make_again(store: Store, manifest: Manifest, splits: Sequence[str],
                meshes: str | os.PathLike[str] | None, jobs: int, names: Sequence[str],
                console: Console) -> None:
    """Set files aside, and generate what is missing then."""
    # Whatever stands in the way of making them again is said before anything is set aside.
    root = manifest.meshes_root(meshes)
    adopt(store, make_plan(manifest, root, splits),
          lambda: make_plan(manifest.by_chance_alone(), root, splits))
    _set_aside(store, names, console)
    console.print(generate(manifest, store.url, meshes, jobs, splits=splits).table())


def _set_aside(store: Store, names: Sequence[str], console: Console) -> None:
    for name in names:  # a shard's index with it
        for moved in quarantine(store, name) if is_shard(name) else set_aside(store, name):
            _say(console, f"set aside as {moved}")


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False)
