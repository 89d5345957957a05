"""`export_dataset`: every sample of a data set in one format, in parallel, resumable.

A sample whose files are all there is kept. `export-FORMAT.json` in the output folder records the data set and
the settings, so that a later run with others is refused instead of mixed in.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple, cast

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.export.dense import dense_files
from ocnf_data.export.lists import write_lists
from ocnf_data.export.mesh import mesh_files
from ocnf_data.export.points import points_files
from ocnf_data.export.sample import ExportSample
from ocnf_data.export.settings import Coordinates, ExportFormat, ExportSettings
from ocnf_data.export.vdb import openvdb, vdb_files
from ocnf_data.files.lock import exclusive
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_data.manifest import Manifest
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.shards.browse import StoredSample
from ocnf_data.shards.dataset import DatasetInfo, ShardEntry, load_dataset
from ocnf_data.shards.reader import ShardReader

_FILES: dict[ExportFormat, Callable[[ExportSample], dict[str, bytes]]] = {
    ExportFormat.DENSE: dense_files,
    ExportFormat.POINTS: points_files,
    ExportFormat.MESH: mesh_files,
    ExportFormat.VDB: vdb_files,
}
# The last file that is written of a sample: where it is, the others are.
_LAST = {
    ExportFormat.DENSE: "{split}/{key}.npz",
    ExportFormat.POINTS: "deepsdf/SdfSamples/ocnf/{category}/{key}.npz",
    ExportFormat.MESH: "{split}/{key}.ply",
    ExportFormat.VDB: "{split}/{key}.vdb",
}
_OF_THE_RUN = frozenset({"disk_full", "missing_extra", "permission", "unreachable", "unwritable"})


class Exported(NamedTuple):
    """The outcome of one sample.

    Attributes:
        key, category: the sample's; of one whose shard cannot be read, its shard and number, and nothing.
        size: bytes written; None where it was there already.
        error: why nothing was written.
    """

    key: str
    category: str
    size: int | None = None
    error: OcnfError | None = None


@dataclass
class ExportReport:
    """The account of an export: every sample asked for was written, kept or failed.

    Attributes:
        out: the folder.
        written: samples written in this run.
        kept: samples that were there already.
        failures: (key, error) of those that cannot be exported.
        size: bytes written.
    """

    out: str
    written: int = 0
    kept: int = 0
    failures: list[tuple[str, OcnfError]] = field(default_factory=list)
    size: int = 0

    def __str__(self) -> str:
        total = self.written + self.kept + len(self.failures)
        return (f"{total} samples = {self.written} written + {self.kept} kept + {len(self.failures)} failed; "
                f"{self.size / 1e6:.1f} MB written to {self.out}")


class _Task(NamedTuple):
    """The first samples of a shard."""

    split: str
    entry: ShardEntry
    n: int


def export_dataset(
    url: str | os.PathLike[str],
    out: str | os.PathLike[str],
    format: ExportFormat | str,
    *,
    splits: Sequence[str] | None = None,
    limit: int | None = None,
    resolution: int | None = None,
    variant: str | None = None,
    encoding: Encoding | str | None = None,
    points: int = 100_000,
    coordinates: Coordinates | str | None = None,
    stored: bool = False,
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> ExportReport:
    """Write the samples of a data set in a format that other programs read.

    What is written depends on the data set and the settings alone, not on `jobs` or on interruptions; where a
    run was stopped, the same call goes on.

    Args:
        url: the data set, a folder or fsspec URL.
        out: where the files go, a folder or fsspec URL.
        format: `dense`, `points`, `mesh` or `vdb`.
        splits: names of the splits; None is all.
        limit: largest number of samples of each split, from its beginning; None is all.
        resolution: voxels along a side; None is the largest.
        variant: the input variant to write, for dense, mesh and vdb; None is all.
        encoding: the input encoding to write, for dense; None is all.
        points: number of points of each kind and sample, for points.
        coordinates: `metres`, `unit-cube` or `unit-sphere`; None is what the readers of each file expect.
        stored: dense volumes in the dtype on disk instead of float32.
        jobs: worker processes.
        progress: called with (samples done, samples in all).

    Raises:
        OcnfError: no such data set or split, settings that do not fit the format or the data set's manifest,
            a folder with an export of other settings (`misfit`), a missing library. A sample that cannot be
            exported is a failure in the report and does not stop the others.
    """
    settings = ExportSettings(  # which turns names into what they stand for
        cast(ExportFormat, format), resolution, variant, cast("Encoding | None", encoding), points,
        cast("Coordinates | None", coordinates), stored)
    if settings.format is ExportFormat.VDB:
        openvdb()
    source, target = Store(url), Store(out)
    info = load_dataset(source)
    if f"{target.url.rstrip('/')}/".startswith(f"{source.url.rstrip('/')}/"):
        raise OcnfError("the export would lie in the data set, whose every file is accounted for",
                        where=out, field="out", expected="a folder beside it")
    _check(settings, info, source)
    tasks = list(_tasks(info.splits, splits, limit, source))
    total = sum(task.n for task in tasks)
    report = ExportReport(target.url)
    listed: dict[str, list[tuple[str, str]]] = {task.split: [] for task in tasks}
    done = 0
    with exclusive(target):
        begun = _adopt(target, settings, info.identity)
        there = frozenset(target.list())
        for task, rows in _run(source, target, settings, tasks, there, jobs):
            for row in rows:
                done += 1
                if row.error is not None:
                    report.failures.append((row.key, row.error))
                else:
                    listed[task.split].append((row.category, row.key))
                    report.kept += row.size is None
                    report.written += row.size is not None
                    report.size += row.size or 0
                if progress is not None:
                    progress(done, total)
        if not (begun or report.written or report.kept):
            target.remove(_record(settings))  # nothing here is of these settings: others may be right
        elif settings.format is ExportFormat.POINTS:
            write_lists(source, target, info, listed)
    report.failures.sort(key=lambda failure: failure[0])
    return report


def _check(settings: ExportSettings, info: DatasetInfo, source: Store) -> None:
    """Refuse what no sample has, before the folder is bound to it."""
    try:
        manifest = Manifest.from_dict(info.manifest)
    except OcnfError:  # no manifest of this version's: the samples will say
        return

    def refuse(field: str, found: object, there: Sequence[object]) -> OcnfError:
        return OcnfError(f"the data set has no such {field}", code="missing", where=source.url, field=field,
                         found=found, expected=", ".join(map(str, there)))

    if settings.format is ExportFormat.POINTS and isinstance(manifest.source, SequenceSource):
        raise OcnfError("most of a scan's cube was never looked at: points and occupancies there would be "
                        "made up", where=source.url, field="format", found=settings.format,
                        expected="mesh, dense or vdb", fix="take the surface that was measured, with mesh")
    if settings.resolution not in (None, *manifest.resolutions):
        raise refuse("resolution", settings.resolution, manifest.resolutions)
    if settings.variant not in (None, *(one.name for one in manifest.inputs)):
        raise refuse("variant", settings.variant, [one.name for one in manifest.inputs])
    asked = [one for one in manifest.inputs if settings.variant in (None, one.name)]
    encodings = list(dict.fromkeys(encoding for one in asked for encoding in one.encodings))
    if settings.encoding not in (None, *encodings):
        raise refuse("encoding", settings.encoding, encodings)


def _tasks(shards: dict[str, tuple[ShardEntry, ...]], splits: Sequence[str] | None, limit: int | None,
           source: Store) -> Iterator[_Task]:
    if limit is not None and limit < 1:
        raise OcnfError("not a number of samples", where="export", field="limit", found=limit,
                        expected="1 or more")
    for split in dict.fromkeys(splits if splits is not None else shards):
        if split not in shards:
            raise OcnfError("the data set has no such split", code="missing", where=source.url, field="split",
                            found=split, expected=", ".join(shards))
        left = limit
        for entry in shards[split]:
            n = entry.samples if left is None else min(left, entry.samples)
            if n:
                yield _Task(split, entry, n)
            left = None if left is None else left - n


def _record(settings: ExportSettings) -> str:
    return f"export-{settings.format}.json"


def _adopt(target: Store, settings: ExportSettings, identity: str) -> bool:
    """Record what is exported, or refuse to go on with something else; whether it was recorded before."""
    name = _record(settings)
    record = {"data_set": identity, **settings.to_dict()}
    if target.exists(name):
        try:
            before = json.loads(target.read_at_most(name, 2**20))
            known = {field: before[field] for field in record}
        except (ValueError, KeyError, TypeError):
            raise OcnfError("the record of an export is damaged", code="damaged", where=target.where(name),
                            fix="export into another folder") from None
        for setting, value in record.items():
            if known[setting] != value:
                raise OcnfError("the folder holds an export of other settings", code="misfit",
                                where=target.where(name), field=setting, found=_said(value),
                                expected=_said(known[setting]),
                                fix="give the same settings, or another folder")
        return True
    target.put_bytes(name, canonical_json(record))
    return False


def _run(source: Store, target: Store, settings: ExportSettings, tasks: list[_Task], there: frozenset[str],
         jobs: int) -> Iterator[tuple[_Task, Iterator[Exported]]]:
    """The rows of each task, in the order of the tasks."""
    if jobs == 1 or len(tasks) <= 1:
        for task in tasks:
            yield task, _export(source, target, settings, task, there)
        return
    try:
        import joblib
    except ImportError as error:
        raise missing_extra("several jobs need joblib", "generate") from error
    parallel = joblib.Parallel(n_jobs=min(jobs, len(tasks)), backend="loky", return_as="generator")
    found = parallel(joblib.delayed(_export_all)(source, target, settings, task,
                                                 _of_task(there, settings, task)) for task in tasks)
    for task, rows in zip(tasks, found, strict=True):
        yield task, iter(rows)


def _of_task(there: frozenset[str], settings: ExportSettings, task: _Task) -> frozenset[str]:
    """The names that matter to a task: those of a split go along with its shards, and no others."""
    by_split = "{split}" in _LAST[settings.format]
    return frozenset(name for name in there if not by_split or name.startswith(f"{task.split}/"))


def _export_all(source: Store, target: Store, settings: ExportSettings, task: _Task,
                there: frozenset[str]) -> list[Exported]:
    return list(_export(source, target, settings, task, there))


def _export(source: Store, target: Store, settings: ExportSettings, task: _Task,
            there: frozenset[str]) -> Iterator[Exported]:
    with ShardReader(source, task.split, task.entry) as reader:
        try:
            samples = reader.index.samples
        except OcnfError as error:
            yield from (Exported(f"{reader.path}[{n}]", "", error=error) for n in range(task.n))
            return
        for position, entry in enumerate(islice(samples, task.n)):
            last = _LAST[settings.format].format(split=task.split, key=entry.key, category=entry.category)
            if last in there:
                yield Exported(entry.key, entry.category)
                continue
            try:
                sample = ExportSample(StoredSample(reader, position, entry), settings)
                files = _FILES[settings.format](sample)
                for name in sorted(files, key=lambda name: name == last):
                    target.put_bytes(name, files[name])
            except OcnfError as error:
                if error.code in _OF_THE_RUN:
                    raise
                yield Exported(entry.key, entry.category, error=error)
            else:
                yield Exported(entry.key, entry.category, size=sum(map(len, files.values())))


def _said(setting: object) -> object:
    return "nothing" if setting is None else setting
