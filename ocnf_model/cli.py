"""`ocnf-model`: train, evaluate, use and inspect networks.

A command imports what it needs when it runs, so that `--help` answers at once.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from ocnf_data.terminal import GivenOnce, run_app, show_version, stoppable
from ocnf_model.completion.commands import complete_app
from ocnf_model.evaluation.methods import Method
from ocnf_model.tables.command import tables_command

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  rich_markup_mode="markdown",
                  help="OctNetFusion: train, evaluate and inspect networks, and fuse depth with them.")
app.add_typer(complete_app, name="complete")
_out = Console(emoji=False)
_err = Console(stderr=True, emoji=False)
_debug = False


Run = Annotated[str, typer.Argument(metavar="RUN", help="A run's folder, `pretrained` or `pretrained-scan`.")]
Training = Annotated[str, typer.Argument(
    metavar="DATA", help="A data set, a folder or an fsspec URL; or a manifest (.yaml), whose samples are "
                         "made as they are needed.")]
Data = Annotated[str, typer.Argument(metavar="DATA", help="A data set: a folder, or an fsspec URL.")]
Device = Annotated[str, typer.Option(metavar="NAME", help="The device to run on: auto, cpu, cuda, cuda:1.")]


@app.callback()
def _options(debug: Annotated[bool, typer.Option(
        "--debug", help="Show where in the code an error was raised.")] = False,
        version: Annotated[bool, typer.Option(
            "--version", callback=show_version, is_eager=True, help="Show the version.")] = False) -> None:
    global _debug
    _debug = debug


@app.command("train")
@stoppable(_err, "the same command goes on in {out}")
def train_command(
    data: Training,
    out: Annotated[Path, typer.Option(metavar="RUN", help="Folder of the run: new, or to be gone on with.")],
    levels: Annotated[int | None, typer.Option(min=1, help="Resolutions, coarse to fine. [3]")] = None,
    device: Device = "auto",
    meshes: Annotated[Path | None, typer.Option(
        metavar="ROOT", help="The folder that a manifest's mesh paths are relative to.")] = None,
    val: Annotated[str | None, typer.Option(
        metavar="DIR", help="Data set to validate with. [DATA's own; a manifest's is made in RUN/validation]",
    )] = None,
    settings: Annotated[Path | None, typer.Option(
        metavar="FILE", help="A YAML or JSON file with any of the settings; options override it.")] = None,
    start: Annotated[str | None, typer.Option(
        metavar="RUN", help="A run whose weights the levels begin with: its folder, or pretrained.")] = None,
    encoding: Annotated[str | None, typer.Option(
        help="Input encoding: occupancy, tsdf, tdf_occupancy or histogram. [histogram]")] = None,
    variant: Annotated[str | None, typer.Option(
        help="The input variant, by its name in the manifest.")] = None,
    epochs: Annotated[str | None, typer.Option(
        metavar="N,...",
        help="Epochs of each level; the last number holds for all later levels. A run can be continued with "
             "more, or ended with fewer. [50,25,25]")] = None,
    batch_size: Annotated[str | None, typer.Option(
        metavar="N,...", help="Samples per batch and process, level by level. [4,1,1]")] = None,
    accumulate: Annotated[str | None, typer.Option(
        metavar="N,...", help="Batches per optimiser step, level by level. [1,4,4]")] = None,
    learning_rate: Annotated[str | None, typer.Option(
        metavar="X,...", help="Learning rate of Adam, level by level. [1e-4]")] = None,
    decay: Annotated[str | None, typer.Option(
        metavar="NAME,...",
        help="How the learning rate falls, level by level: none or cosine. [none]")] = None,
    channels: Annotated[str | None, typer.Option(
        metavar="A,B,C", help="Channels at the three resolutions within a level. [16,32,64]")] = None,
    join: Annotated[str | None, typer.Option(
        help="How encoder features are joined to the decoder: concat or add. [concat]")] = None,
    carry: Annotated[str | None, typer.Option(
        help="What a level passes to the next: features or reconstruction. [features]")] = None,
    output: Annotated[str | None, typer.Option(
        help="What the network predicts: tsdf or occupancy. [the data set's target]")] = None,
    augment: Annotated[str | None, typer.Option(
        help="Random symmetries of the samples: none, rotations, flips or all. [none]")] = None,
    precision: Annotated[str | None, typer.Option(
        help="Arithmetic: float32, or bfloat16 for the activations. [float32]")] = None,
    checkpointing: Annotated[bool | None, typer.Option(
        "--checkpointing/--no-checkpointing", help="Compute activations again instead of keeping them.",
        show_default=False)] = None,
    best_by: Annotated[str | None, typer.Option(
        help="Measure that chooses the best checkpoint: mad, iou, f_score or mad_and_f_score. "
             "[mad_and_f_score]")] = None,
    seed: Annotated[int | None, typer.Option(
        min=0, help="Seed of the first weights and the order of the samples. [0]")] = None,
    workers: Annotated[int | None, typer.Option(
        min=0, help="Processes that read samples, per training process. [1]")] = None,
) -> None:
    """Train a network, stage by stage, coarse to fine; by default with the paper's schedule.

    Training may be stopped at any time, even by a power cut: the same command resumes it. RUN gets the best
    checkpoint of every level, the curves as CSV and for TensorBoard, and the settings.

    `torchrun --nproc-per-node N -m ocnf_model.cli train ...` trains on N GPUs.
    """
    from ocnf_model.devices import keep_freed_memory
    from ocnf_model.training.options import merge_options, refuse_long_lists
    from ocnf_model.training.record import is_begun
    from ocnf_model.training.run import train

    keep_freed_memory()
    of_stages = {"epochs": epochs, "batch_size": batch_size, "accumulate": accumulate,
                 "learning_rate": learning_rate, "decay": decay}
    chosen = merge_options(
        settings,
        {"levels": levels, "encoding": encoding, "variant": variant, "join": join, "carry": carry,
         "output": output, "augment": augment, "precision": precision, "checkpointing": checkpointing,
         "best_by": best_by, "start": start, "seed": seed, "workers": workers},
        of_stages, channels)
    if not is_begun(out):
        refuse_long_lists(chosen.levels, settings, of_stages, shortened=levels is not None)
    train(data, out, chosen, device=device, console=_err, meshes=meshes, val=val)
    if os.environ.get("RANK", "0") == "0":
        _out.print(f"trained: {escape(str(out))}", highlight=False)


@app.command("info")
@stoppable(_err, "nothing was changed")
def run_info_command(run: Run) -> None:
    """Show a network's layers, shapes and parameters, and how it was trained."""
    from ocnf_model.info import print_run

    print_run(run, _out)


@app.command("evaluate")
@stoppable(_err, "tables are written at the end only, and the same command starts again")
def evaluate_command(
    run: Run,
    data: Data,
    split: Annotated[str, typer.Option(help="The split of the data set to evaluate on.")] = "test",
    out: Annotated[Path | None, typer.Option(
        metavar="DIR", help="Where tables and figures go; RUN/evaluation/SPLIT if not given.")] = None,
    device: Device = "auto",
    method: Annotated[list[Method] | None, typer.Option(
        help="A method to compare; may be repeated. [all]")] = None,
    weights: Annotated[Path | None, typer.Option(
        metavar="FILE",
        help="TV-L1's weights, as `choose-weight` writes them; RUN/tvl1.json if it exists.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Evaluate only the first N models.")] = None,
    figures: Annotated[int, typer.Option(
        min=0, help="Number of models to draw, each of another category.")] = 3,
    up: Annotated[str, typer.Option(help="The models' axis that points up in the figures: y or z.")] = "z",
    meshes: Annotated[Path | None, typer.Option(
        metavar="DIR", help="The folder that the data set was made from: measure surfaces against its meshes "
                            "instead of the finest ground truth.")] = None,
    html: Annotated[Path | None, typer.Option(
        metavar="FILE", help="Also write a page with every model in 3-D, to be opened in a browser.")] = None,
) -> None:
    """Compare the network with plain and TV-L1 fusion: error by region, surface, overlap, time; and a figure.

    Chamfer distance, F-score at one voxel and normal consistency are of 30,000 samples of each surface; thin
    parts have a recall of their own.
    """
    from ocnf_model.evaluation.run import run_evaluate

    methods = [str(name) for name in method] if method else None
    run_evaluate(run, data, split=split, out=out, device=device, methods=methods, weights=weights,
                 limit=limit, n_figures=figures, up=up, console=_out, meshes=meshes, html=html)


@app.command("choose-weight")
@stoppable(_err, "{out} is written at the end only, and the same command starts again")
def choose_weight_command(
    data: Data,
    out: Annotated[Path, typer.Option(
        metavar="FILE", help="Where the weights go; `evaluate` finds RUN/tvl1.json by itself.")],
    split: Annotated[str, typer.Option(
        help="The split to choose on; never the one that results are reported on.")] = "val",
    resolution: Annotated[list[int] | None, typer.Option(
        help="A resolution to choose for; may be repeated. [all]")] = None,
    models: Annotated[int | None, typer.Option(
        min=1, help="Number of models to use. [20 up to 64³, 10 at 128³, 5 above]")] = None,
    weights: Annotated[str | None, typer.Option(
        metavar="X,...", help="At least 6 weights, ascending; more are added where the best is at an end. "
                              "[0.4,0.64,1,1.6,2.5,4,6.4]")] = None,
) -> None:
    """Choose TV-L1's weight by cross-validation: the least MAD, for each resolution and input variant."""
    from ocnf_model.evaluation.weights import CANDIDATE_WEIGHTS, run_choose_weight
    from ocnf_model.training.options import parse_list

    grid = CANDIDATE_WEIGHTS if weights is None else parse_list("weights", weights)
    run_choose_weight(data, out=out, resolutions=resolution, n_models=models, split=split, weights=grid,
                      console=_out)
    _out.print(f"The weights are in {escape(str(out))}", highlight=False, soft_wrap=True)


app.command("tables")(stoppable(
    _err, "what is finished is kept, and the same command goes on")(tables_command))


@app.command("fuse", cls=GivenOnce)
@stoppable(_err, "meshes are written at the end only, and the same command starts again")
def fuse_command(
    run: Run,
    scan: Annotated[str, typer.Argument(
        metavar="SCAN", help="Depth with poses: `views.h5::KEY`, or a folder: 7-Scenes, TUM RGB-D, "
                             "Open3D, transforms.json, ScanNet, Voxlets.")],
    out: Annotated[Path | None, typer.Option(
        metavar="MESH", help="The mesh to write: .ply, .obj, .glb, .off or .stl. Of several methods, "
                             "MESH-METHOD each. May be left out with --preview.")] = None,
    box: Annotated[tuple[float, float, float, float, float, float] | None, typer.Option(
        metavar="X0 Y0 Z0 X1 Y1 Z1",
        help="Region in the scan's coordinates, metres. [the cube that the scan names, else the largest "
             "object]")] = None,
    room: Annotated[bool, typer.Option("--room", help="Fuse everything that the frames see.")] = False,
    voxel: Annotated[float | None, typer.Option(
        metavar="METRES", help="Size of a voxel: the region is worked in as many cubes as that takes. [the "
                               "region fits one cube]")] = None,
    method: Annotated[list[str] | None, typer.Option(
        metavar="NAME,...", help="The method that fuses, network (also: ours), volfus or tvl1; or several. "
                                 "[network]")] = None,
    resolution: Annotated[int | None, typer.Option(
        help="Voxels along a cube. [the finest that RUN has, 256 for the others]")] = None,
    device: Device = "auto",
    weight: Annotated[float | None, typer.Option(
        help="Weight of TV-L1's data term; small is smooth.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Take every n-th frame only.")] = 1,
    frames: Annotated[str | None, typer.Option(
        metavar="N|A:B:C", help="How many frames, evenly spread, or a range of them. [all]")] = None,
    max_depth: Annotated[float | None, typer.Option(
        metavar="METRES", help="Do not use what was measured farther away.")] = None,
    keep_unseen: Annotated[bool, typer.Option(
        "--keep-unseen", help="Keep surfaces that close off what no camera has seen.")] = False,
    keep_all: Annotated[bool, typer.Option(
        "--keep-all", help="Keep loose parts of the surface, of less than 16 voxels.")] = False,
    faces: Annotated[int | None, typer.Option(
        metavar="N", help="Decimate each mesh to about N faces.")] = None,
    tsdf: Annotated[Path | None, typer.Option(
        metavar="FILE", help="Write the TSDF too: .npz is dense, .oc an octree.")] = None,
    picture: Annotated[Path | None, typer.Option(
        metavar="PNG", help="Draw the surfaces of all methods side by side.")] = None,
    preview: Annotated[Path | None, typer.Option(
        metavar="PNG", help="First draw the region over the measured points and the cameras.")] = None,
    format_: Annotated[str | None, typer.Option(
        "--format", metavar="NAME",
        help="7scenes, tum, open3d, transforms, scannet or voxlets. [what the folder holds]")] = None,
    depth_scale: Annotated[float | None, typer.Option(
        help="Units of the stored depth in a metre. [the format's]")] = None,
    intrinsics: Annotated[str | None, typer.Option(
        metavar="FX,FY,CX,CY", help="Intrinsics of the depth maps, in pixels. [the scan's]")] = None,
    poses: Annotated[str | None, typer.Option(
        metavar="DIRECTION", help="camera-to-world or world-to-camera. [the format's]")] = None,
    axes: Annotated[str | None, typer.Option(
        metavar="NAME", help="Axes of the cameras in the poses: opencv (y down, z forward) or opengl (y up, "
                             "z backward). [the format's]")] = None,
    pose_scale: Annotated[float, typer.Option(
        help="Metres a unit of the poses' translations: 0.001 for millimetres.")] = 1.0,
    crop: Annotated[str, typer.Option(
        metavar="L,T,R,B", help="Pixels along the borders of the depth maps that are not used.")] = "0,0,0,0",
    no_colour: Annotated[bool, typer.Option(
        "--no-colour", help="Leave the colour images alone: the mesh gets no colours.")] = False,
) -> None:
    """Fuse depth frames with known poses into a mesh, in the scan's coordinates."""
    began = time.perf_counter()
    _out.print(f"fusing {escape(scan)}: loading", highlight=False, soft_wrap=True)

    from ocnf_model.scan.run import Asked, run_fuse
    from ocnf_model.training.options import parse_list

    reading = {
        "frames": frames, "every": every, "format": format_, "depth_scale": depth_scale, "poses": poses,
        "axes": axes, "pose_scale": pose_scale, "crop": parse_list("crop", crop), "colour": not no_colour,
        "intrinsics": None if intrinsics is None else parse_list("intrinsics", intrinsics)}
    run_fuse(scan, Asked(
        out, run, method or ("ours",), box, room, voxel, resolution, max_depth,
        keep_unseen, keep_all, faces, device, weight, tsdf, picture, preview, reading), _out, began)


def main() -> None:
    """Run the command line."""
    # Read when PyTorch loads OpenMP, which is later. By default its threads wait for each other by spinning,
    # so beside another process they use up the time that the one they wait for would need.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    run_app(app, _err, lambda: _debug)


if __name__ == "__main__":
    main()
