"""`ocnf-data show`, `stats` and `check`; the scripts in tools/ are the same functions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ocnf_data.encodings import Encoding

_out = Console(emoji=False, soft_wrap=True)

_Folder = Annotated[str, typer.Argument(metavar="DIR", help="A data set: a folder, or an fsspec URL.")]
_Meshes = Annotated[Path | None, typer.Option(
    "--meshes", "--root", metavar="ROOT",
    help="The folder that the meshes or scans were read from. [what the manifest says]")]


def show_command(
    data: _Folder,
    key: Annotated[list[str] | None, typer.Option(
        metavar="PART", help="Draw the sample whose key has this in it; may be repeated. "
                             "[the first of each split]")] = None,
    random_: Annotated[int, typer.Option("--random", min=0, help="Draw this many samples at random.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of --random.")] = 0,
    meshes: _Meshes = None,
    variant: Annotated[str | None, typer.Option(help="Which input. [the first]")] = None,
    encoding: Annotated[Encoding | None, typer.Option(help="Which encoding. [the input's first]")] = None,
    up: Annotated[str, typer.Option(help="Which axis of the meshes points up: y or z.")] = "z",
    out: Annotated[Path, typer.Option(
        "--out", "--pictures", metavar="DIR",
        help="Folder for the pictures, or the name of a .png for a single one.")] = Path("pictures"),
) -> None:
    """Draw samples as PNG: mesh, every input view, and the octrees of input and ground truth.

    Without the meshes, the surface of the ground truth stands in for them.
    """
    from ocnf_data.errors import OcnfError
    from ocnf_data.files.targets import check_target
    from ocnf_data.inspection.choose import pick
    from ocnf_data.inspection.show import draw_sample
    from ocnf_data.manifest import Manifest
    from ocnf_data.shards.dataset import load_dataset
    from ocnf_data.terminal import check_up

    check_up(up)
    manifest = Manifest.from_dict(load_dataset(data).manifest)
    samples = pick(data, key or [], random_, seed)
    single = out.suffix.lower() == ".png"
    check_target(out if single else out / "sample.png", [".png"])
    if single and len(samples) > 1:
        raise OcnfError("one file, but several samples", where=out, field="--out", found=len(samples),
                        expected="a folder", fix="name one sample with --key, or give a folder")
    for sample in samples:
        path = out if single else out / f"{sample.key}.png"
        draw_sample(sample, manifest, path, meshes, variant, encoding, up)
        _out.print(str(path), highlight=False, markup=False)


def stats_command(
    data: _Folder,
    split: Annotated[str | None, typer.Option(help="Only this split.")] = None,
    out: Annotated[Path, typer.Option("--out", "--plot", metavar="FILE", help="Where the plot goes.")] =
        Path("pictures/stats.png"),
    band_samples: Annotated[int, typer.Option(
        min=0, help="Decode so many ground truths a category for the band; 0: all.")] = 3,
    mad: Annotated[bool, typer.Option("--mad", help="Also plain fusion's error in millimetres.")] = False,
) -> None:
    """Leaves, band and coverage by category: a table, and a box plot."""
    from ocnf_data.files.targets import check_target
    from ocnf_data.inspection.pictures import PICTURE_SUFFIXES
    from ocnf_data.inspection.stats import collect, draw, print_table

    check_target(out, PICTURE_SUFFIXES)  # before all samples are read
    columns = collect(data, split, band_samples, mad)
    print_table(columns, Console(emoji=False))
    draw(columns, out)
    _out.print(str(out), highlight=False, markup=False)


def check_command(
    data: _Folder,
    meshes: _Meshes = None,
    samples: Annotated[int, typer.Option(min=1, help="How many samples to check.")] = 3,
    cells: Annotated[int, typer.Option(min=1, help="How many voxels of each octree.")] = 10_000,
    seed: Annotated[int, typer.Option(min=0, help="Which samples and voxels.")] = 0,
    all_rows: Annotated[bool, typer.Option("--all", help="Print what is right, too.")] = False,
) -> None:
    """Compare stored octrees with their meshes, by a float64 evaluation that shares no code with fusion.

    `verify` checks bytes; this checks that they mean what they should. The exit status is 1 if they do not.
    """
    from ocnf_data.inspection.check import run_check

    right = run_check(data, meshes, samples, cells, seed, all_rows, Console(emoji=False))
    raise typer.Exit(0 if right else 1)
