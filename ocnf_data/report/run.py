"""`write_report`: the page of a data set, from its shards and, where they are at hand, its meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.interrupts import joblib_results
from ocnf_data.files.storage import Store
from ocnf_data.manifest import Manifest
from ocnf_data.report.contents import Card
from ocnf_data.report.overview import data_page
from ocnf_data.report.page import PageWriter
from ocnf_data.report.recording import Recording
from ocnf_data.report.sample import Choice, make_card, page_scale
from ocnf_data.shards.browse import StoredSample
from ocnf_data.shards.dataset import DatasetInfo, ShardEntry, load_dataset
from ocnf_data.shards.index import shard_path
from ocnf_data.shards.reader import ShardReader
from ocnf_data.terminal import check_up

_CHUNK = 4  # samples of a task: enough that a worker's start does not matter
_OF_THE_RUN = frozenset({"disk_full", "missing_extra", "permission", "unreachable", "unwritable"})


class Drawn(NamedTuple):
    """A sample that was drawn, or why not."""

    key: str
    card: Card | None = None
    error: OcnfError | None = None


class ReportResult(NamedTuple):
    """What was written.

    Attributes:
        paths: the page, the folder beside it if there is one, and the recording if there is one.
        n_samples: samples on the page.
        failures: (key, error) of samples that could not be shown.
    """

    paths: list[Path]
    n_samples: int
    failures: list[tuple[str, OcnfError]]


class _Task(NamedTuple):
    split: str
    entry: ShardEntry
    first: int
    n: int


def write_report(url: str, out: Path, *, meshes: Path | None = None, splits: list[str] | None = None,
                 limit: int | None = None, variant: str | None = None, resolution: int | None = None,
                 triangles: int = 20_000, up: str = "z", jobs: int = 1, rerun: Path | None = None,
                 progress: Callable[[int, int], None] | None = None) -> ReportResult:
    """Write the page of a data set.

    Args:
        url: the data set, a folder or fsspec URL.
        out: the HTML file.
        meshes: the folder of the meshes; None: where the manifest says, if that is there, else the ground
            truth's surface stands in for them.
        splits: names of the splits; None is all.
        limit: at most so many samples of each split; None is all.
        variant: which input; None: the first.
        resolution: voxels along a side of what is shown; None: the largest.
        triangles: at most so many of each surface.
        up: the axis of the meshes that points up, y or z.
        jobs: worker processes.
        rerun: also a recording of the samples for the rerun viewer, FILE.rrd; None: none.
        progress: called with (samples done, samples in all).

    Raises:
        OcnfError: no such data set, split, input or resolution; the page cannot be written. A sample that
            cannot be read is named on the page and in the result, and the others are shown.
    """
    check_up(up)
    writer = PageWriter(out)
    store = Store(url)
    info = load_dataset(store)
    manifest = Manifest.from_dict(info.manifest)
    choice = _choose(manifest, variant, resolution, triangles, up, url)
    tasks = list(_tasks(info, splits, limit, url))
    if meshes is not None and not meshes.is_dir():
        raise OcnfError("no such folder", code="missing", where=meshes, field="--meshes",
                        expected="the folder that the meshes were read from")
    recording = None if rerun is None else Recording(rerun, page_scale(manifest, choice), up)
    total = sum(task.n for task in tasks)
    failures: list[tuple[str, OcnfError]] = []
    cards: list[Card] = []
    draw = partial(_draw, store, manifest, choice, meshes)
    for done, drawn in enumerate(_run(draw, tasks, jobs), 1):
        if drawn.error is not None:
            failures.append((drawn.key, drawn.error))
        elif drawn.card is not None:
            writer.add(drawn.card)
            if recording is not None:
                recording.add(drawn.card)
            cards.append(drawn.card._replace(thumbnail=b"", blob=""))
        if progress is not None:
            progress(done, total)
    if recording is not None:
        recording.finish()
    page = data_page(store, info, manifest, choice, cards, failures)
    paths = [*writer.finish(page), *([] if rerun is None else [rerun])]
    return ReportResult(paths, len(writer), failures)


def _choose(manifest: Manifest, variant: str | None, resolution: int | None, triangles: int, up: str,
            url: str) -> Choice:
    chosen = next((one for one in manifest.inputs if variant in (None, one.name)), None)
    if chosen is None:
        raise OcnfError("the data set has no such input", code="missing", where=url, field="variant",
                        found=variant, expected=", ".join(one.name for one in manifest.inputs) or "none")
    if resolution is not None and resolution not in manifest.resolutions:
        raise OcnfError("the data set has no such resolution", code="missing", where=url, field="resolution",
                        found=resolution, expected=", ".join(map(str, manifest.resolutions)))
    return Choice(chosen, resolution or max(manifest.resolutions), triangles, up)


def _tasks(info: DatasetInfo, splits: list[str] | None, limit: int | None, url: str) -> Iterator[_Task]:
    for split in dict.fromkeys(splits or info.splits):
        if split not in info.splits:
            raise OcnfError("the data set has no such split", code="missing", where=url, field="split",
                            found=split, expected=", ".join(info.splits))
        left = limit if limit is not None else info.counts.samples
        for entry in info.splits[split]:
            n = min(left, entry.samples)
            left -= n
            for first in range(0, n, _CHUNK):
                yield _Task(split, entry, first, min(_CHUNK, n - first))


def _run(draw: Callable[[_Task], list[Drawn]], tasks: list[_Task], jobs: int) -> Iterator[Drawn]:
    """The samples in their order, whatever the number of workers."""
    if jobs == 1 or len(tasks) <= 1:
        for task in tasks:
            yield from draw(task)
        return
    try:
        import joblib
    except ImportError as error:
        raise missing_extra("several jobs need joblib", "generate") from error
    parallel = joblib.Parallel(n_jobs=min(jobs, len(tasks)), backend="loky", return_as="generator")
    with joblib_results(lambda: parallel(joblib.delayed(draw)(task) for task in tasks)) as found:
        for rows in found:
            yield from rows


def _draw(store: Store, manifest: Manifest, choice: Choice, meshes: Path | None, task: _Task) -> list[Drawn]:
    rows = []
    keys = [f"{shard_path(task.split, task.entry.shard)}[{task.first + n}]" for n in range(task.n)]
    try:
        with ShardReader(store, task.split, task.entry) as reader:
            keys = [entry.key for entry in reader.index.samples[task.first : task.first + task.n]]
            for position, key in enumerate(keys, task.first):
                sample = StoredSample(reader, position, reader.index.samples[position])
                try:
                    rows.append(Drawn(key, make_card(sample, manifest, choice, meshes)))
                except OcnfError as error:
                    rows.append(_undrawn(key, error))
    except OcnfError as error:  # of the shard: none of its samples can be read
        rows += [_undrawn(key, error) for key in keys[len(rows):]]
    return rows


def _undrawn(key: str, error: OcnfError) -> Drawn:
    if error.code in _OF_THE_RUN:
        raise error
    return Drawn(key, error=error)
