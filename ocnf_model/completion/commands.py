"""`ocnf-model complete`: a frame of one's own, train, evaluate, and the baselines alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ocnf_data.terminal import stoppable

complete_app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown",
                           help="Complete tabletops from a single depth map, and measure it on Voxlets.")
_out = Console(emoji=False)
_err = Console(stderr=True, emoji=False)

_Data = Annotated[str, typer.Option(
    "--data", metavar="VOXLETS", help="Folder of the Voxlets data: fold_0, fold_1 and train_test.")]
_Results = Annotated[Path, typer.Option(metavar="DIR", help="Where the table, the figures of all frames and "
                                                            "the pictures go.")]
_Device = Annotated[str, typer.Option(metavar="NAME", help="The device to run on: auto, cpu, cuda, cuda:1.")]
_Split = Annotated[str, typer.Option(help="The split to measure on: test or train.")]
_Forest = Annotated[bool, typer.Option(
    "--forest/--no-forest", help="Fit the structured forest too, which takes some minutes.")]
_Figures = Annotated[int, typer.Option(min=0, help="Number of frames to draw.")]


@complete_app.command("frame")
@stoppable(_err, "nothing was written, and the same command starts again")
def complete_frame_command(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run's folder, or `pretrained`.")],
    scan: Annotated[str, typer.Argument(metavar="SCAN", help="Depth with poses, in any format that "
                                                             "`ocnf-model fuse` reads.")],
    out: Annotated[Path, typer.Option(
        metavar="FILE", help="A mesh (.ply, .obj, .glb, .off, .stl), or .npz: the probabilities, and where "
                             "their grid lies.")],
    frame: Annotated[str | None, typer.Option(
        metavar="NAME", help="The frame: its name, or its number from 0; the first if not given.")] = None,
    device: _Device = "auto",
) -> None:
    """Complete what stands on a table, from one depth map of your own.

    The table is the largest plane that the camera looks down on, and the things are those in the middle of
    the picture, at most 39 cm tall. They are written whole, in the scan's coordinates.
    """
    from ocnf_model.completion.single import run_complete_frame

    run_complete_frame(run, scan, out, frame=frame, device=device, console=_out)


@complete_app.command("train")
@stoppable(_err, "the same command goes on in {out}")
def complete_train_command(
    data: _Data,
    out: Annotated[Path, typer.Option(metavar="RUN", help="Folder of the run: new, or to be gone on with.")],
    settings: Annotated[Path | None, typer.Option(
        metavar="FILE", help="A YAML or JSON file with any of the settings of `ocnf-model train`.")] = None,
    synthetic: Annotated[int, typer.Option(
        min=0, help="Number of synthetic tabletops to begin with.")] = 40,
    device: _Device = "auto",
) -> None:
    """Train on synthetic tabletops, then on the training scenes, of which every sixth is held out.

    Training may be stopped at any time: the same command resumes it. At the end, the threshold is chosen on
    the frames that were held out.
    """
    from ocnf_model.completion.train import run_completion_training

    run_completion_training(data, out, settings=settings, synthetic=synthetic, device=device, console=_err)


@complete_app.command("evaluate")
@stoppable(_err, "tables are written at the end only, and the same command starts again")
def complete_evaluate_command(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run's folder, or `pretrained`.")],
    data: _Data,
    out: _Results,
    split: _Split = "test",
    forest: _Forest = True,
    figures: _Figures = 3,
    device: _Device = "auto",
) -> None:
    """Compare the network with all baselines: IoU, precision and recall of each frame and their means."""
    from ocnf_model.completion.evaluate import run_completion_evaluation

    run_completion_evaluation(run, data, out=out, split=split, forest=forest, figures=figures, device=device,
                              console=_out)


@complete_app.command("baselines")
@stoppable(_err, "tables are written at the end only, and the same command starts again")
def complete_baselines_command(
    data: _Data,
    out: _Results,
    split: _Split = "test",
    forest: _Forest = True,
    figures: _Figures = 0,
) -> None:
    """Measure what needs no network."""
    from ocnf_model.completion.evaluate import run_completion_evaluation

    run_completion_evaluation(None, data, out=out, split=split, forest=forest, figures=figures, console=_out)
