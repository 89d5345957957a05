"""Train a network from nothing and compare it with its baselines: what `make demo TRAIN=1` runs.

python tools/demo_train.py --out demo-out --seed 0

Everything is learned from scratch, on procedural shapes of which two noisy depth maps show a part: the rest
is for the network to complete. It differs from the paper's setting where that saves time, and says so.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.generation import generate
from ocnf_data.manifest import Manifest, load_manifest
from ocnf_data.terminal import print_error
from ocnf_model.evaluation.methods import Method
from ocnf_model.evaluation.run import WEIGHTS_FILE, Evaluation, run_choose_weight, run_evaluate
from ocnf_model.evaluation.summary import ALL
from ocnf_model.training.run import train
from ocnf_model.training.schedule import Decay, Stage
from ocnf_model.training.settings import TrainSettings

MANIFEST = Path(__file__).parent.parent / "manifests" / "demo-train.yaml"

SETTINGS = TrainSettings(
    levels=2, channels=(8, 16, 32), stages=(
        Stage(epochs=10, batch_size=2, accumulate=1, learning_rate=2e-3, decay=Decay.COSINE),
        Stage(epochs=2, batch_size=1, accumulate=1, learning_rate=1e-3, decay=Decay.COSINE)))
PAPER = TrainSettings()


def differences() -> list[str]:
    """What the settings have other than the paper's, a line each."""
    lines = [f"channels {SETTINGS.channels}, the paper has {PAPER.channels}",
             f"{SETTINGS.levels} levels, the paper has {PAPER.levels}"]
    for level in range(SETTINGS.levels):
        ours, paper = SETTINGS.stage(level), PAPER.stage(level)
        lines.append(f"level {level + 1}: {ours.epochs} epochs of batches of {ours.batch_size}, learning rate"
                     f" {ours.learning_rate:g} falling to 0; the paper has {paper.epochs} of "
                     f"{paper.batch_size * paper.accumulate} at {paper.learning_rate:g}")
    return lines


def verdict(found: Evaluation, console: Console) -> bool:
    """Say at each resolution whether the network is better than both baselines."""
    mads = {(one.resolution, one.method): one.mad_mm for one in found.summaries if one.category == ALL}
    won = True
    for resolution in sorted({resolution for resolution, _ in mads}):
        volfus, tvl1, ours = (mads[resolution, method.label] for method in Method)
        better = ours < min(volfus, tvl1)
        won &= better
        console.print(f"{resolution}³: ours {ours:.2f} mm, VolFus {volfus:.2f} mm, TV-L1 {tvl1:.2f} mm: "
                      + (f"[green]{1 - ours / min(volfus, tvl1):.0%} less than the better one[/]" if better
                         else "[red]not better than both[/]"), highlight=False)
    return won


def main(
    out: Annotated[Path, typer.Option(help="Folder for data, run and pictures.")] = Path("demo-out"),
    seed: Annotated[int, typer.Option(help="Seed of shapes, noise, weights and order.")] = 0,
    jobs: Annotated[int, typer.Option(help="Worker processes that generate.")] = 2,
) -> None:
    """Generate shapes, train on them from scratch, choose TV-L1's weight, compare on shapes never seen."""
    console = Console()
    begin = time.perf_counter()

    def step(title: str) -> None:
        console.print(f"\n[bold]{title}[/]  [dim]({time.perf_counter() - begin:.0f} s)[/]", highlight=False)

    try:
        manifest = Manifest.from_dict({**load_manifest(MANIFEST).to_dict(), "seed": seed})
        data, run = out / f"train-{seed}", out / f"train-{seed}-run"
        step(f"1. Generate: ocnf-data generate manifests/{MANIFEST.name} --out {data} --jobs {jobs}")
        console.print(generate(manifest, data, None, jobs).table())
        step(f"2. Train from scratch: ocnf-model train {data} --out {run}, with")
        for line in differences():
            console.print(f"   {line}", highlight=False)
        train(data, run, SETTINGS.model_copy(update={"seed": seed}), device="auto", console=console)
        weights = run / WEIGHTS_FILE
        step(f"3. TV-L1's weight on the validation split: ocnf-model choose-weight {data} --out {weights}")
        run_choose_weight(str(data), out=weights, console=console)
        step(f"4. Compare on shapes never seen: ocnf-model evaluate {run} {data}")
        found = run_evaluate(str(run), str(data), console=console)
    except OcnfError as error:
        print_error(str(error), Console(stderr=True))
        raise typer.Exit(1) from None
    console.print()
    won = verdict(found, console)
    console.print(f"\nDone in {time.perf_counter() - begin:.0f} s. Look at {run / 'evaluation' / 'test'}; "
                  f"the curves: tensorboard --logdir {run}", highlight=False)
    raise typer.Exit(0 if won else 1)


if __name__ == "__main__":
    typer.run(main)
