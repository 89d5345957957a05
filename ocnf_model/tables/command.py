"""`ocnf-model tables`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from ocnf_model.tables import WEIGHT_MODELS

_out = Console(emoji=False, soft_wrap=True)
_err = Console(stderr=True, emoji=False)


def tables_command(
    name: Annotated[str, typer.Argument(
        metavar="NAME", help="encodings, views, noise, unseen, kinect, completion, runtime or all.")],
    data: Annotated[Path, typer.Option(
        metavar="ROOT", help="Folder of meshes, laid out as ModelNet: ROOT/CATEGORY/train and test.")],
    out: Annotated[Path, typer.Option(
        metavar="DIR", help="Folder of all that is made: new, or to be gone on with.")],
    meshes: Annotated[int | None, typer.Option(
        min=1, metavar="N", help="Meshes to train a network on, over all categories. [200 of each]")] = None,
    test: Annotated[int | None, typer.Option(
        min=1, metavar="N", help="Meshes of each category to test on. [20]")] = None,
    levels: Annotated[int | None, typer.Option(min=1, max=3, help="Resolutions, coarse to fine. [3]")] = None,
    epochs: Annotated[str | None, typer.Option(
        metavar="N,...", help="Epochs of each level; the last number holds for later ones. [50,25,25]",
    )] = None,
    hours: Annotated[float | None, typer.Option(
        min=0, metavar="H", help="Training time of each network, in the place of epochs.")] = None,
    settings: Annotated[Path | None, typer.Option(
        metavar="FILE", help="Training settings, a YAML file as for `train`. [the paper's]")] = None,
    resolutions: Annotated[str | None, typer.Option(
        metavar="N,...", help="Voxels along each axis, level by level. [64,128,256]")] = None,
    categories: Annotated[str | None, typer.Option(
        metavar="A,B,...", help="Folders of ROOT to use. [the paper's where all are there, else all]",
    )] = None,
    stand_in: Annotated[list[str] | None, typer.Option(
        metavar="CATEGORY=FOLDER", help="A folder that takes the place of a category of the paper; may be "
                                        "repeated.")] = None,
    weight_models: Annotated[int, typer.Option(
        min=1, metavar="N", help="Validation meshes that TV-L1's weight is chosen on.")] = WEIGHT_MODELS,
    device: Annotated[str, typer.Option(metavar="NAME", help="auto, cpu, cuda, cuda:1.")] = "auto",
    jobs: Annotated[int, typer.Option(min=1, metavar="N", help="Worker processes of generation.")] = 1,
    scans: Annotated[Path | None, typer.Option(
        metavar="DIR", help="Folder of scans, for the table kinect: depth frames with poses.")] = None,
    voxlets: Annotated[Path | None, typer.Option(
        metavar="DIR", help="Folder of the Voxlets data, for the table completion.")] = None,
    up: Annotated[str, typer.Option(help="The meshes' axis that points up in the figures: y or z.")] = "z",
    dry_run: Annotated[bool, typer.Option(
        "--dry-run", help="Print the steps with their time and disk, measured on a few meshes, and do none.",
    )] = False,
) -> None:
    """Make a table of the paper from a folder of meshes: data, networks, evaluation, and the table.

    Without a budget it is the paper's. The command may be stopped at any time: run again, it goes on. What
    one table made another uses. DIR/tables gets Markdown, CSV and LaTeX, the paper's figures beside ours.
    """
    from ocnf_data.errors import OcnfError
    from ocnf_model.tables.run import make_tables
    from ocnf_model.training.options import merge_options, parse_list

    stand_ins = dict(pair.partition("=")[::2] for pair in stand_in or ())
    if not all(stand_ins.values()):
        raise OcnfError("not a category and a folder", field="--stand-in", found=", ".join(stand_in or ()),
                        expected="such as desk=table")
    grids = None if resolutions is None else [int(one) for one in parse_list("resolutions", resolutions)]
    levels = levels or (None if grids is None else len(grids))
    plan = make_tables(
        name, data, out, meshes=meshes, test=test,
        settings=merge_options(settings, {"levels": levels}, {}), resolutions=grids,
        epochs=None if epochs is None else [int(one) for one in parse_list("epochs", epochs)], hours=hours,
        categories=None if categories is None else categories.split(","), stand_ins=stand_ins,
        weight_models=weight_models, device=device, jobs=jobs, scans=scans,
        voxlets=voxlets, up=up, dry_run=dry_run,
        console=_err)
    if not dry_run:
        for step in plan.left:
            if step.table is not None:
                _out.print(escape(str(out / step.target)), highlight=False)
    if plan.notes:
        raise typer.Exit(1)
