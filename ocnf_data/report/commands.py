"""`ocnf-data report`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

_out = Console(emoji=False, soft_wrap=True)
_err = Console(stderr=True, emoji=False)
_MOST_NAMED = 10  # samples that could not be shown


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def report_command(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="A data set: a folder, or an fsspec URL.")],
    jobs: Annotated[int, typer.Option(
        min=1, metavar="N", default_factory=_cores, show_default="one a core", help="Worker processes.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("report.html"),
    meshes: Annotated[Path | None, typer.Option(
        metavar="ROOT", help="The folder that the meshes were read from. [what the manifest says]")] = None,
    split: Annotated[list[str] | None, typer.Option(
        metavar="NAME", help="A split to show; may be given several times.", show_default="all")] = None,
    limit: Annotated[int | None, typer.Option(
        min=1, metavar="N", help="At most N samples of each split.", show_default="all")] = None,
    variant: Annotated[str | None, typer.Option(help="Which input. [the first]")] = None,
    resolution: Annotated[int | None, typer.Option(
        metavar="N", help="Voxels along a side of what is shown.", show_default="the largest")] = None,
    triangles: Annotated[int, typer.Option(min=100, metavar="N", help="The most of a surface.")] = 20_000,
    up: Annotated[str, typer.Option(help="Which axis of the meshes points up: y or z.")] = "z",
    rerun: Annotated[Path | None, typer.Option(
        metavar="FILE.rrd", help="Also write a recording of the samples for the rerun viewer.")] = None,
) -> None:
    """Write one HTML page to look at: statistics, failures, a gallery, and every sample in 3-D.

    The page needs no network and opens from the disk. Beyond 50 MB the geometry of the samples lies in a
    folder beside it, FILE's name and `_files`, which belongs to it.
    """
    from rich.progress import Progress

    from ocnf_data.report.run import write_report
    from ocnf_data.terminal import print_error

    with Progress(console=_err, disable=not _err.is_terminal) as progress:
        task = progress.add_task("drawing", total=None)
        done = write_report(folder, out, meshes=meshes, splits=split, limit=limit, variant=variant,
                            resolution=resolution, triangles=triangles, up=up, jobs=jobs, rerun=rerun,
                            progress=lambda n, total: progress.update(task, completed=n, total=total))
    for key, error in done.failures[:_MOST_NAMED]:
        print_error(f"{key}: {error}".replace(f"{key}: {key}: ", f"{key}: "), _err)
    if len(done.failures) > _MOST_NAMED:
        print_error(f"and {len(done.failures) - _MOST_NAMED} more: the page's tab Failures names them", _err)
    for path in done.paths:
        _out.print(str(path), highlight=False, markup=False)
    raise typer.Exit(1 if done.failures else 0)
