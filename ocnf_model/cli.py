"""`ocnf-model`: train, evaluate, use and look at networks.

A command imports what it needs when it runs, so that `--help` answers at once.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from ocnf_data.terminal import run_app
from ocnf_model.evaluation.methods import Method

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  rich_markup_mode="markdown",
                  help="OctNetFusion: train it, evaluate it, fuse depth with it, look at it.")
_out = Console(emoji=False)
_err = Console(stderr=True, emoji=False)
_debug = False


Run = Annotated[str, typer.Argument(metavar="RUN", help="A run's folder, or `pretrained`.")]
Training = Annotated[str, typer.Argument(
    metavar="DATA", help="A data set, a folder or an fsspec URL; or a manifest (.yaml), whose samples are "
                         "made as they are needed.")]
Data = Annotated[str, typer.Argument(metavar="DATA", help="A data set: a folder, or an fsspec URL.")]
Device = Annotated[str, typer.Option(metavar="NAME", help="auto, cpu, cuda, cuda:1.")]


@app.callback()
def _options(debug: Annotated[bool, typer.Option(
        "--debug", help="Show where in the code an error was raised.")] = False) -> None:
    global _debug
    _debug = debug


@app.command("train")
def train_command(
    data: Training,
    out: Annotated[Path, typer.Option(metavar="RUN", help="Folder of the run: new, or to be gone on with.")],
    levels: Annotated[int | None, typer.Option(min=1, help="Resolutions, coarse to fine. [3]")] = None,
    device: Device = "auto",
    meshes: Annotated[Path | None, typer.Option(
        metavar="ROOT", help="With a manifest: the folder that its mesh paths are relative to.")] = None,
    val: Annotated[str | None, typer.Option(
        metavar="DIR", help="Data set to validate with. [DATA's own; a manifest's is made in RUN/validation]",
    )] = None,
    settings: Annotated[Path | None, typer.Option(
        metavar="FILE", help="YAML or JSON with any of the settings; options go before it.")] = None,
    encoding: Annotated[str | None, typer.Option(
        help="occupancy, tsdf, tdf_occupancy or histogram. [histogram]")] = None,
    variant: Annotated[str | None, typer.Option(help="Name of the inputs in the manifest.")] = None,
    epochs: Annotated[str | None, typer.Option(
        metavar="N,...", help="For each level; the last one holds for all that follow. A run may be gone on "
                              "with for more. [50,25,25]")] = None,
    batch_size: Annotated[str | None, typer.Option(
        metavar="N,...", help="Samples a batch, for each level and process. [4,1,1]")] = None,
    accumulate: Annotated[str | None, typer.Option(
        metavar="N,...", help="Batches a step, for each level. [1,4,4]")] = None,
    learning_rate: Annotated[str | None, typer.Option(
        metavar="X,...", help="Of Adam, for each level. [1e-4]")] = None,
    decay: Annotated[str | None, typer.Option(
        metavar="NAME,...",
        help="Of the learning rate, for each level: none or cosine. [none]")] = None,
    channels: Annotated[str | None, typer.Option(
        metavar="A,B,C", help="Of the three resolutions within a level. [16,32,64]")] = None,
    join: Annotated[str | None, typer.Option(help="concat or add. [concat]")] = None,
    carry: Annotated[str | None, typer.Option(help="features or reconstruction. [features]")] = None,
    output: Annotated[str | None, typer.Option(help="tsdf or occupancy. [the data set's target]")] = None,
    augment: Annotated[str | None, typer.Option(help="none, rotations, flips or all. [none]")] = None,
    precision: Annotated[str | None, typer.Option(
        help="float32, or bfloat16 for the activations. [float32]")] = None,
    checkpointing: Annotated[bool | None, typer.Option(
        "--checkpointing/--no-checkpointing", help="Compute activations again instead of keeping them.",
        show_default=False)] = None,
    best_by: Annotated[str | None, typer.Option(
        help="Measure by which the best checkpoint is chosen: mad, iou, f_score or mad_and_f_score. "
             "[mad_and_f_score]")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of weights and order. [0]")] = None,
    workers: Annotated[int | None, typer.Option(
        min=0, help="Reading processes, for each training process. [1]")] = None,
) -> None:
    """Train a network, stage by stage, coarse to fine; by default with the paper's schedule.

    Stop it at any time, with Ctrl-C or a power cut: the same command goes on where it was. RUN gets the best
    checkpoint of every level, the curves as CSV and for TensorBoard, and the settings.

    `torchrun --nproc-per-node N -m ocnf_model.cli train ...` trains on N GPUs.
    """
    from ocnf_model.training.options import merge_options
    from ocnf_model.training.run import train

    chosen = merge_options(
        settings,
        {"levels": levels, "encoding": encoding, "variant": variant, "join": join, "carry": carry,
         "output": output, "augment": augment, "precision": precision, "checkpointing": checkpointing,
         "best_by": best_by, "seed": seed, "workers": workers},
        {"epochs": epochs, "batch_size": batch_size, "accumulate": accumulate,
         "learning_rate": learning_rate, "decay": decay},
        channels)
    try:
        train(data, out, chosen, device=device, console=_err, meshes=meshes, val=val)
    except KeyboardInterrupt:
        _err.print(f"[yellow]stopped; the same command goes on in {escape(str(out))}[/]", highlight=False)
        raise typer.Exit(130) from None
    if os.environ.get("RANK", "0") == "0":
        _out.print(f"trained: {escape(str(out))}", highlight=False)


@app.command("info")
def run_info_command(run: Run) -> None:
    """Show a network's layers, shapes and parameters, and how it was trained."""
    from ocnf_model.info import print_run

    print_run(run, _out)


@app.command("evaluate")
def evaluate_command(
    run: Run,
    data: Data,
    split: Annotated[str, typer.Option(help="Of the data set.")] = "test",
    out: Annotated[Path | None, typer.Option(
        metavar="DIR", help="Where tables and figures go; RUN/evaluation/SPLIT if not given.")] = None,
    device: Device = "auto",
    method: Annotated[list[Method] | None, typer.Option(help="May be repeated. [all]")] = None,
    weights: Annotated[Path | None, typer.Option(
        metavar="FILE", help="TV-L1's, chosen by cross-validation; RUN/tvl1.json if there is one.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="The first so many models only.")] = None,
    figures: Annotated[int, typer.Option(min=0, help="Models to draw, each of another category.")] = 3,
    up: Annotated[str, typer.Option(help="The models' axis that points up in the figures: y or z.")] = "z",
    meshes: Annotated[Path | None, typer.Option(
        metavar="DIR", help="The folder that the data set was made from: measure surfaces against its meshes "
                            "instead of the finest ground truth.")] = None,
) -> None:
    """Compare the network with plain and TV-L1 fusion: error by region, surface, overlap, time; and a figure.

    Chamfer distance, F-score at one voxel and normal consistency are of 30,000 samples of each surface; thin
    parts have a recall of their own.
    """
    from ocnf_model.evaluation.run import run_evaluate

    methods = [str(name) for name in method] if method else None
    run_evaluate(run, data, split=split, out=out, device=device, methods=methods, weights=weights,
                 limit=limit, n_figures=figures, up=up, console=_out, meshes=meshes)


@app.command("choose-weight")
def choose_weight_command(
    data: Data,
    out: Annotated[Path, typer.Option(
        metavar="FILE", help="Where the weights go; `evaluate` finds RUN/tvl1.json by itself.")],
    split: Annotated[str, typer.Option(help="Of the data set; never the one reported on.")] = "val",
    resolution: Annotated[list[int] | None, typer.Option(help="May be repeated. [all]")] = None,
    models: Annotated[int | None, typer.Option(
        min=1, help="How many. [20 up to 64³, 10 at 128³, 5 above]")] = None,
    weights: Annotated[str | None, typer.Option(
        metavar="X,...", help="At least 6, ascending; more are added where the best is at an end. "
                              "[0.4,0.64,1,1.6,2.5,4,6.4]")] = None,
) -> None:
    """Choose TV-L1's weight by cross-validation: the least MAD, for each resolution and input variant."""
    from ocnf_model.evaluation.weights import CANDIDATE_WEIGHTS, run_choose_weight
    from ocnf_model.training.options import parse_list

    grid = CANDIDATE_WEIGHTS if weights is None else parse_list("weights", weights)
    run_choose_weight(data, out=out, resolutions=resolution, n_models=models, split=split, weights=grid,
                      console=_out)
    _out.print(f"The weights are in {escape(str(out))}", highlight=False, soft_wrap=True)


@app.command("fuse")
def fuse_command(
    run: Run,
    scan: Annotated[str, typer.Argument(
        metavar="SCAN", help="Depth with poses: `views.h5::KEY`, or a folder of frames.")],
    out: Annotated[Path, typer.Option(metavar="MESH", help="The mesh to write: .ply, .obj, .off or .stl.")],
    box: Annotated[tuple[float, float, float, float, float, float] | None, typer.Option(
        metavar="X0 Y0 Z0 X1 Y1 Z1",
        help="Region in the scan's coordinates; the largest object if not given.")] = None,
    method: Annotated[Method, typer.Option(help="What fuses.")] = Method.OURS,
    resolution: Annotated[int | None, typer.Option(
        help="Voxels along the region; the finest that RUN has if not given.")] = None,
    device: Device = "auto",
    weight: Annotated[float | None, typer.Option(help="Of TV-L1.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Take every n-th frame only.")] = 1,
    keep_unseen: Annotated[bool, typer.Option(
        "--keep-unseen", help="Keep surfaces that close off what no camera has seen.")] = False,
) -> None:
    """Fuse depth frames with known poses into a mesh, in the scan's coordinates."""
    from ocnf_model.scan.fuse import run_fuse

    run_fuse(run, scan, out=out, box=box, method=str(method), resolution=resolution, device=device,
             weight=weight, every=every, keep_unseen=keep_unseen, console=_out)


def main() -> None:
    """Run the command line."""
    run_app(app, _err, lambda: _debug)


if __name__ == "__main__":
    main()
