"""`generate`: from a manifest to a folder of shards, resumable at any moment.

    plan.json -> shards, each with its failures and its index -> failures.jsonl -> catalogues -> dataset.json

Every step leaves whole files, and the order makes each file a proof of those before it: a folder without
`dataset.json` is unfinished, a shard without its index is not there.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from ocnf_data.errors import OcnfError
from ocnf_data.files.lock import exclusive
from ocnf_data.files.storage import Store
from ocnf_data.generation.account import done_before, finish
from ocnf_data.generation.backends import run_tasks
from ocnf_data.generation.fingerprint import view_fingerprint
from ocnf_data.generation.outcome import Report, split_notes
from ocnf_data.generation.plan import Plan, make_plan
from ocnf_data.generation.progress import ProgressDisplay, live_folder
from ocnf_data.generation.resume import adopt
from ocnf_data.generation.sequences import scan_notes
from ocnf_data.generation.shard_task import ShardDone, ShardTask
from ocnf_data.generation.worker import supervisor
from ocnf_data.generation.worker.supervisor import ChildLimits, ChildSetup
from ocnf_data.manifest import SPLITS, Manifest, load_manifest
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.shards.dataset import DAMAGE, DATASET, find_dataset
from ocnf_data.views.store import ViewStore

VIEWS = "views"


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, after everything was left resumable; the text says how far the run was."""


def generate(
    manifest: Manifest | str | os.PathLike[str],
    out: str | os.PathLike[str],
    meshes: str | os.PathLike[str] | None = None,
    jobs: int = 1,
    backend: str = "loky",
    *,
    retry_failed: bool = False,
    views: str | os.PathLike[str] | None = None,
    splits: Sequence[str] = SPLITS,
    progress: bool = True,
) -> Report:
    """Make the data set that a manifest defines; in a folder where that was begun, finish it.

    The bytes of what comes out depend on the manifest and the meshes alone (and on the versions of libraries,
    which `plan.json` records): not on `jobs`, `backend`, interruptions or the machine's load. The one
    exception are items that crash or hang, which become rows of `failures.jsonl`.

    Args:
        manifest: a manifest, or the path of its YAML.
        out: a folder or fsspec URL. `memory://` takes jobs=1 only.
        meshes: the folder that the manifest's paths, of meshes or scans, are relative to.
        jobs: worker processes, each using one core.
        backend: `loky` (this machine), `dask` or `ray`; the latter two join the cluster that the environment
            variable DASK_SCHEDULER_ADDRESS or RAY_ADDRESS names, and else start `jobs` local workers.
        retry_failed: make the shards with failures again.
        views: a folder of views that a run with `views: keep` left (its OUT/views): meshes that are there, as
            this manifest's cameras see them, are not rendered again. What comes out is the same.
        splits: which of the manifest's splits to make.
        progress: show how far the run is, on standard error.

    Raises:
        OcnfError: bad manifest, missing meshes, a folder begun with something else, a full disk, ...
        Interrupted: Ctrl-C. What is finished stays; the same call resumes.
    """
    begin = time.perf_counter()
    if not isinstance(manifest, Manifest):
        manifest = load_manifest(manifest)
    store = Store(out)
    _check_places(store, jobs, backend, keeps=manifest.views == "keep", views=views)
    if views is not None and isinstance(manifest.source, SequenceSource):
        raise OcnfError("the views of scans are their own, and none are rendered", field="views", found=views,
                        fix="leave it out")
    root = manifest.meshes_root(meshes)
    console = Console(stderr=True, quiet=not progress)
    with exclusive(store):
        plan, warnings = adopt(store, make_plan(manifest, root, splits),
                               lambda: make_plan(manifest.by_chance_alone(), root, splits))
        for note in split_notes(plan, manifest, splits):
            console.print(f"note: {note}", highlight=False, markup=False)
        if isinstance(manifest.source, SequenceSource) and root is not None:
            warnings += scan_notes(manifest.source, root)
        if views is not None:
            warnings += _compare_views(views, plan, manifest)
        for warning in warnings:
            console.print(f"[yellow]warning:[/] {escape(warning)}")
        store.clean_temporaries()  # of a run that was killed
        finished = store.exists(DATASET)
        # Another schema is damage too: the plan, which was compared, is of this version of ocnf.
        before = find_dataset(store, damage=DAMAGE | {"schema"}) if finished else None
        damaged = finished and before is None
        if damaged:
            console.print("note: dataset.json is damaged; it is written again from plan.json and the shards, "
                          "which are read in full", highlight=False, markup=False)
        done = done_before(store, plan, before, retry_failed=retry_failed, check_sha256=damaged)
        if before is not None and any(shard.name not in done for shard in plan.shards) and retry_failed:
            store.remove(DATASET)  # its shards are about to change
            before = None
        setup = ChildSetup(_without_items(plan.manifest), None if root is None else str(root),
                           views=None if views is None else Store(views).url,
                           keep_views=store.where(VIEWS) if manifest.views == "keep" else None,
                           maker=supervisor.DEFAULT_MAKER)
        limits = ChildLimits(item_seconds=manifest.limits.timeout_s)
        made = _make_missing(store, plan, setup, limits, jobs, backend, console, done)
        info, failures = finish(store, plan, manifest.name, done, before)
    return Report(store.url, info.counts.items, info.counts.samples, failures, plan.exclusions, made,
                  sum(entry.size for _, entry in info.shards()), time.perf_counter() - begin,
                  manifest.limits.failure_threshold, tuple(warnings))


def _check_places(store: Store, jobs: int, backend: str, keeps: bool,
                  views: str | os.PathLike[str] | None) -> None:
    if jobs < 1:
        raise OcnfError("not a number of jobs", field="jobs", found=jobs, expected="1 or more")
    if not store.shared_between_processes:
        if jobs > 1 or backend != "loky":
            raise OcnfError("memory:// lives in one process: what workers write there is lost", field="jobs",
                            where=store.url, found=f"{jobs} with {backend}", expected="1 with loky")
        if keeps:
            raise OcnfError("memory:// lives in one process: views kept there by another are lost",
                            where=store.url, field="views", found="keep", expected="drop")
    if views is not None and Store(views).root is not None and not Path(views).is_dir():
        raise OcnfError("no folder of views", code="missing", where=views, field="views",
                        fix="give the folder `views` of a data set made with `views: keep`")


def _compare_views(views: str | os.PathLike[str], plan: Plan, manifest: Manifest) -> list[str]:
    """A sentence if the kept views are of no use; OcnfError if they are those of other items altogether."""
    kept = ViewStore(views)
    keys = kept.kept([item.key for item in plan.items])
    if not keys:
        raise OcnfError("no views of any of the items are kept there", code="missing", where=views,
                        field="views", expected="KEY.h5 of the items' keys, as `views: keep` leaves them",
                        fix="give the folder `views` of a data set of the same meshes, or leave it out")
    with contextlib.suppress(OcnfError):  # a damaged file is rendered again, and is no reason to stop
        if kept.fingerprint(keys[0]) == view_fingerprint(manifest):
            return []
    return [f"the views in {views} are of other cameras or of another placement: all are rendered again"]


def _without_items(manifest: dict[str, Any]) -> dict[str, Any]:
    """The manifest without its list of meshes: it goes along with every shard, which brings its own items."""
    source = manifest["source"]
    if source["kind"] != "list":
        return manifest
    split, entries = next((split, entries) for split, entries in source["items"].items() if entries)
    return {**manifest, "source": {**source, "items": {split: entries[:1]}}}  # none at all would be refused


def _make_missing(store: Store, plan: Plan, setup: ChildSetup, limits: ChildLimits, jobs: int, backend: str,
                  console: Console, done: dict[str, ShardDone]) -> int:
    """Make the shards that are not in `done` and add them; returns how many items they have."""
    left = [shard for shard in plan.shards if shard.name not in done]
    sizes = {shard.name: len(shard.items) for shard in left}
    n_items = sum(sizes.values())
    try:
        with live_folder(store, shared=backend == "loky") as live:
            display = ProgressDisplay(n_items, live, console)
            where = None if live is None else str(live)
            tasks = [ShardTask(store.url, shard, setup, limits, where) for shard in left]
            with display.shown(), contextlib.closing(run_tasks(tasks, jobs, backend)) as finished:
                for one in finished:
                    done[one.name] = one
                    display.shard_finished(one.name, sizes[one.name], len(one.failures))
    except KeyboardInterrupt:
        raise Interrupted(f"stopped with {len(done)} of {len(plan.shards)} shards finished; "
                          "what is finished is kept, and the same command resumes") from None
    finally:
        store.clean_temporaries()  # of workers that died
    return n_items
