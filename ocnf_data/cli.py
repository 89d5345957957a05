"""`ocnf-data`: begin, generate, verify, inspect, repair and export data sets.

A command imports what it needs when it runs, so that `--help` answers at once.
"""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape

from ocnf_data.encodings import Encoding
from ocnf_data.export.settings import Coordinates, ExportFormat
from ocnf_data.inspection.commands import check_command, show_command, stats_command
from ocnf_data.report.commands import report_command
from ocnf_data.terminal import print_error, run_app, show_version, stoppable

if TYPE_CHECKING:
    from collections.abc import Callable

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  rich_markup_mode="markdown",
                  help="Grid-octree training data from meshes: generate, verify, inspect, repair and export.")
_out = Console(emoji=False)  # `shapes:airplane:train:1` is a name
_err = Console(stderr=True, emoji=False)
_debug = False


class Backend(StrEnum):
    """Where workers run."""

    LOKY = "loky"
    DASK = "dask"
    RAY = "ray"


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


Folder = Annotated[str, typer.Argument(metavar="DIR", help="A data set: a folder, or an fsspec URL.")]
Meshes = Annotated[Path | None, typer.Option(
    "--meshes", "--root", metavar="ROOT",
    help="The folder that the manifest's paths, of meshes or scans, are relative to.")]
Jobs = Annotated[int, typer.Option(
    min=1, metavar="N", default_factory=_cores, show_default="one a core",
    help="Worker processes, each using one core and up to 0.7 GB.")]


@app.callback()
def _options(debug: Annotated[bool, typer.Option(
        "--debug", help="Show where in the code an error was raised.")] = False,
        version: Annotated[bool, typer.Option(
            "--version", callback=show_version, is_eager=True, help="Show the version.")] = False) -> None:
    global _debug
    _debug = debug


@app.command("manifests")
def manifests_command() -> None:
    """List the manifests that come along: `ocnf-data init NAME` writes one to edit."""
    from ocnf_data.manifest.shipped import shipped_manifests
    from ocnf_data.terminal import narrow_table

    table = narrow_table("ocnf-data init NAME writes one to edit")
    table.padding = (0, 1)
    for title in ("name", "needs", "what it is"):
        table.add_column(title, no_wrap=title != "what it is", overflow="fold")
    for shipped in shipped_manifests():
        table.add_row(shipped.name, "--meshes" if shipped.needs_meshes else "no files", escape(shipped.says))
    _out.print(table)


@app.command("init")
def init_command(
    name: Annotated[str, typer.Argument(metavar="NAME", help="One of `ocnf-data manifests`.")] = "meshes",
    out: Annotated[Path | None, typer.Option(
        metavar="FILE", help="The file to write; never one that is there already. [NAME.yaml]")] = None,
) -> None:
    """Write a manifest to edit. [meshes: every mesh in a folder of your own]"""
    from ocnf_data.manifest.shipped import shipped_manifests, write_manifest

    path = write_manifest(name, out)
    meshes = next(one.needs_meshes for one in shipped_manifests() if one.name == name.removesuffix(".yaml"))
    _out.print(f"{path}: edit it, then  ocnf-data generate {path}{' --meshes DIR' * meshes} --out OUT",
               highlight=False, markup=False, soft_wrap=True)


@app.command("generate")
@stoppable(_err, "what is finished is kept, and the same command goes on")
def generate_command(
    manifest: Annotated[Path, typer.Argument(
        metavar="MANIFEST", help="The manifest: a YAML file that defines the data set.")],
    out: Annotated[str, typer.Option(
        metavar="DIR", help="Where the data set goes: a folder, or an fsspec URL.")],
    jobs: Jobs,
    meshes: Meshes = None,
    backend: Annotated[Backend, typer.Option(
        help="loky: processes on this machine. dask, ray: the cluster that DASK_SCHEDULER_ADDRESS or "
             "RAY_ADDRESS names; without it, a local one of N workers.")] = Backend.LOKY,
    retry_failed: Annotated[bool, typer.Option(
        "--retry-failed", help="Make the shards again in which items failed.")] = False,
    views: Annotated[str | None, typer.Option(
        metavar="DIR", help="Rendered views to use instead of rendering: the folder `views` of a data set "
                            "made with `views: keep`, from the same meshes and cameras.")] = None,
) -> None:
    """Make the data set of a manifest.

    The run may be stopped at any time, even by a power cut: the same command resumes it, and the result is
    the same to the byte. Inputs that cannot be used are listed in DIR/failures.jsonl; the exit status is 1
    when more of them failed than the manifest's limits.failure_threshold.
    """
    from ocnf_data.generation import generate

    report = generate(manifest, out, meshes, jobs, backend.value, retry_failed=retry_failed, views=views)
    _out.print(report.table())
    if report.failures or report.exclusions:
        _out.print(f"each with its reason in {report.out}/failures.jsonl", highlight=False, markup=False)
    if not report.ok:
        _err.print(f"[red]{report.failed_share:.1%} of the items failed; limits.failure_threshold allows "
                   f"{report.threshold:.1%}[/]", highlight=False)
        raise typer.Exit(1)


@app.command("verify")
@stoppable(_err, "nothing was changed, and the same command starts again")
def verify_command(folder: Folder, jobs: Jobs) -> None:
    """Check every byte, count and octree of a data set.

    Names the shard, sample, member and offset of whatever is wrong; the exit status is then 1.
    """
    from ocnf_data.verify.problems import print_verify
    from ocnf_data.verify.verify import verify

    with _Bar("verifying") as progress:
        report = verify(folder, jobs, progress)
    raise typer.Exit(print_verify(report, _out))


@app.command("info")
@stoppable(_err, "nothing was changed")
def dataset_info_command(
    folder: Folder,
    samples: Annotated[bool, typer.Option("--samples", help="List the samples' keys, one a line.")] = False,
) -> None:
    """Show what is in a data set: samples, sizes, leaves, fingerprint. Reads no shard, only indices."""
    from ocnf_data.inspection.choose import sample_keys
    from ocnf_data.verify.summary import describe, print_summary

    if samples:
        _out.print("\n".join(sample_keys(folder)), highlight=False, markup=False, soft_wrap=True)
    else:
        print_summary(describe(folder), _out)


app.command("show")(stoppable(_err, "what is drawn stays")(show_command))
app.command("stats")(stoppable(_err, "nothing was changed")(stats_command))
app.command("check")(stoppable(_err, "nothing was changed")(check_command))
app.command("report")(stoppable(_err, "no page was written; the same command starts again")(report_command))


@app.command("repair")
@stoppable(_err, "what was set aside is in {folder}/quarantine, and the same command goes on")
def repair_command(folder: Folder, jobs: Jobs, meshes: Meshes = None) -> None:
    """Set damaged shards aside in DIR/quarantine and make exactly those again.

    It is an error if a shard comes out different from what dataset.json lists; where that is damaged itself,
    it is written again from the plan and the shards. Nothing is deleted.
    """
    from ocnf_data.generation.mend import mend
    from ocnf_data.verify.problems import VerifyReport
    from ocnf_data.verify.verify import verify

    def look() -> VerifyReport:
        with _Bar("verifying") as progress:
            return verify(folder, jobs, progress)

    left = mend(folder, meshes, jobs, look, _out)
    for problem in left:
        print_error(f"cannot be repaired: {problem}", _err)
    raise typer.Exit(1 if left else 0)


@app.command("export")
def export_command(
    folder: Folder,
    format_: Annotated[ExportFormat, typer.Option(
        "--format", help="dense: volumes as .npz. points: surface points, occupancies and signed distances "
                         "for Occupancy Networks and DeepSDF. mesh: PLY. vdb: OpenVDB.")],
    out: Annotated[str, typer.Option(metavar="OUT", help="Where the files go: a folder, or an fsspec URL.")],
    jobs: Jobs,
    split: Annotated[list[str] | None, typer.Option(
        metavar="NAME", help="A split to export; may be given several times.", show_default="all")] = None,
    resolution: Annotated[int | None, typer.Option(
        metavar="N", help="Voxels along a side, one of the data set's.", show_default="the largest")] = None,
    variant: Annotated[str | None, typer.Option(
        metavar="NAME", help="dense, mesh, vdb: the input variant to export.", show_default="all")] = None,
    encoding: Annotated[Encoding | None, typer.Option(
        help="dense: the input encoding to export.", show_default="all")] = None,
    limit: Annotated[int | None, typer.Option(
        min=1, metavar="N", help="At most N samples of each split.", show_default="all")] = None,
    points: Annotated[int, typer.Option(
        min=1, metavar="N", help="points: how many of each kind, for each sample.")] = 100_000,
    coordinates: Annotated[Coordinates | None, typer.Option(
        help="points, mesh, vdb: the frame of coordinates.",
        show_default="what the readers of each file expect")] = None,
    stored: Annotated[bool, typer.Option(
        "--stored", help="dense: uint8 and float16 as they are stored, instead of float32.")] = False,
) -> None:
    """Write the samples of a data set in a format that other programs read.

    Samples that are there already are kept, so that a run that was stopped goes on; a folder with an export
    of other settings is refused. The exit status is 1 when a sample could not be exported.
    """
    from ocnf_data.export import export_dataset

    with _Bar("exporting") as progress:
        report = export_dataset(folder, out, format_, splits=split or None, limit=limit,
                                resolution=resolution, variant=variant, encoding=encoding, points=points,
                                coordinates=coordinates, stored=stored, jobs=jobs, progress=progress)
    for key, error in report.failures:
        print_error(f"{key}: {error}".replace(f"{key}: {key}: ", f"{key}: "), _err)
    _out.print(str(report), highlight=False, markup=False, soft_wrap=True)
    raise typer.Exit(1 if report.failures else 0)


@app.command("doctor")
@stoppable(_err, "nothing was changed")
def doctor_command() -> None:
    """Check what works on this machine, try each renderer on a known shape, and say how to fix the rest."""
    from ocnf_data.doctor import run_doctor

    raise typer.Exit(run_doctor(_out))


@app.command("watertight")
@stoppable(_err, "every mesh that is written is whole, and the same command makes all of them again")
def watertight_command(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A mesh file, or a folder of them.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A file, or a folder.")],
    jobs: Jobs,
    resolution: Annotated[int, typer.Option(min=8, max=1024, help="Voxels along the cube.")] = 256,
    level: Annotated[float, typer.Option(
        help="How far outside of the measured surface to cut, in truncations: the default, half a voxel, "
             "keeps sheets and wires whole; 0 thickens nothing, and tears them.")] = 0.25,
    suffix: Annotated[str, typer.Option(help="Format in a folder: .ply, .obj, .off or .stl.")] = ".ply",
) -> None:
    """Make meshes watertight: an 80-view TSDF, cut by marching cubes, in the mesh's own coordinates."""
    from ocnf_data.meshes.watertight import watertight_path

    with _Bar("watertight") as progress:
        report = watertight_path(source, out, resolution, jobs, level, suffix, progress)
    for path, error in report.failures:
        sentence = str(error) if error.where == str(path) else f"{path}: {error}"
        print_error(sentence, _err)
    _out.print(f"{len(report.written)} written, {len(report.failures)} failed", highlight=False)
    raise typer.Exit(1 if report.failures else 0)


class _Bar:
    """A progress bar to be called with (done, total)."""

    def __init__(self, what: str) -> None:
        from rich.progress import Progress

        self._progress = Progress(console=_err, disable=not _err.is_terminal)
        self._task = self._progress.add_task(what, total=None)

    def __enter__(self) -> Callable[[int, int], None]:
        self._progress.start()
        return lambda done, total: self._progress.update(self._task, completed=done, total=total)

    def __exit__(self, *error: object) -> None:
        self._progress.stop()


def main() -> None:
    """Run the command line."""
    run_app(app, _err, lambda: _debug)


if __name__ == "__main__":
    main()
