"""What each setting is worth: rows of settings, each trained for the same processor time on one thread.

    python tools/bench/ablate.py OUT --results ablation.jsonl --seconds 200 --seeds 0 1 2
    python tools/bench/ablate.py OUT --results crops.jsonl --level 2 --run RUN --rows whole crop64

Only steps count, not reading: data loaders read at the same time. The learning rate falls by a cosine over
that time, so that slow rows are not stopped while theirs is high. Training draws from all inputs of the data
set alike, validation is the data set's split `val`. Levels from the second on begin with the first levels of
RUN, and with the weights of the level before. Finished rows are read from the results, so that a stopped call
can go on.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from ocnf_data import ShardDataset
from ocnf_data.manifest import Manifest
from ocnf_data.octree.bits import TREE_WIDTH
from ocnf_data.shards import load_dataset
from ocnf_model.checkpoint import Architecture, load_run
from ocnf_model.losses import Pair, l1_loss, truncated_l1_loss
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.training.average import WeightAverage
from ocnf_model.training.batches import AnyBatch, Example, make_example
from ocnf_model.training.crops import crop_losses, draw_corners
from ocnf_model.training.data import open_data
from ocnf_model.training.settings import TrainSettings, read_settings
from ocnf_model.training.validation import Validator

_BATCH = {1: 2}  # samples a step; 1 at later levels
_RATE = {1: 1e-3}  # the learning rate at first; 5e-4 at later levels
_WARM_UP = 20  # steps


def log_l1_loss(prediction: OctreeBatch, target: OctreeBatch, reduction: str) -> Tensor:
    """L1 of sign(t) log(1 + |t|), t in voxels of the truncation, as SG-NN (Dai et al. 2020) has it."""
    pair = Pair.of(prediction, target)
    scaled = [torch.sign(t) * torch.log1p(3 * t.abs()) for t in (pair.prediction, pair.target)]
    return _mean(pair, (scaled[0] - scaled[1]).abs())


def sign_weighted_l1_loss(prediction: OctreeBatch, target: OctreeBatch, reduction: str) -> Tensor:
    """L1 with three times the weight where the sign is wrong."""
    pair = Pair.of(prediction, target)
    wrong = (pair.prediction < 0) != (pair.target < 0)
    return _mean(pair, (pair.prediction - pair.target).abs() * (1 + 2 * wrong))


def _mean(pair: Pair, costs: Tensor) -> Tensor:
    return pair.sum_over_voxels(costs).mean(1) / math.prod(pair.structure.shape)  # (B,)


LOSSES: dict[str, Callable[..., Tensor]] = {
    "l1": l1_loss, "truncated_l1": truncated_l1_loss, "log_l1": log_l1_loss, "sign_l1": sign_weighted_l1_loss}

ROWS: dict[str, dict[str, Any]] = {
    "paper": {},
    "batch_norm": {"normalise": "batch"},
    "residual": {"residual": True},
    "context": {"context": 128},
    "wide": {"channels": [24, 48, 96]},
    "add": {"join": "add"},
    "truncated_l1": {"loss": "truncated_l1"},
    "log_l1": {"loss": "log_l1"},
    "sign_l1": {"loss": "sign_l1"},
    "symmetries": {"augment": "all"},
    "average": {"average": 0.98},
    "norm_context": {"normalise": "batch", "context": 128},
    "norm_average": {"normalise": "batch", "average": 0.98},
    "norm_residual": {"normalise": "batch", "residual": True},
    "norm_truncated": {"normalise": "batch", "loss": "truncated_l1", "average": 0.98},
    "whole": {},
    "crop64": {"crop": 64},
    "crop96": {"crop": 96},
    "crop128": {"crop": 128},
}
"""Settings of each row that differ from the paper's network and its L1 loss."""


@dataclass(frozen=True)
class Task:
    """One run of the bench.

    Attributes:
        row: name in `ROWS`.
        seed: of the weights and of the order of the samples.
        level: which one is trained, from 1.
        seconds: processor time of its steps.
    """

    row: str
    seed: int
    level: int
    seconds: float


class Bench:
    """Trains and measures a row.

    Args:
        data: folder of the data set.
        inputs: names of those that are validated with.
        run: folder of a run whose first levels later ones stand on; None for the first level.
        precision: what the convolutions compute in, for all rows.
    """

    def __init__(self, data: str, inputs: list[str], run: str | None, precision: str) -> None:
        self._data, self._inputs, self._run, self._precision = data, inputs, run, precision
        self._manifest = Manifest.from_dict(load_dataset(data).manifest)

    def run(self, task: Task) -> dict[str, Any]:
        """Steps, and for each input the figures of validation."""
        fields = dict(ROWS[task.row])
        loss = LOSSES[fields.pop("loss", "l1")]
        crop = fields.pop("crop", None)
        stage = {"batch_size": _BATCH.get(task.level, 1), "accumulate": 1, "crop": crop,
                 "learning_rate": _RATE.get(task.level, 5e-4)}
        stages: list[dict[str, Any]] = [{}] * (task.level - 1) + [stage]
        parts = [{"variant": variant.name} for variant in self._manifest.inputs]
        settings = read_settings({**fields, "levels": task.level, "seed": task.seed, "stages": stages,
                                  "mixture": parts, "samples_per_epoch": 2000}, task.row)
        settings = settings.resolved(self._manifest.to_dict(), None, self._data)
        network = self._network(settings, task)
        steps = self._train(network, settings, task, loss)
        scores = {name: self._validate(network.eval(), settings, name) for name in self._inputs}
        return {**asdict(task), "steps": steps, "scores": scores,
                "parameters": sum(p.numel() for p in network.levels[task.level - 1].parameters())}

    def _network(self, settings: TrainSettings, task: Task) -> OctNetFusion:
        torch.manual_seed(task.seed)
        network = Architecture.of(settings).network(settings.levels)
        if self._run is not None:
            before = load_run(self._run)
            for ours, theirs in zip(network.levels[:-1], before.levels, strict=False):
                ours.load_state_dict(theirs.state_dict())
            network.start_from_previous(task.level - 1)
        return network

    def _train(self, network: OctNetFusion, settings: TrainSettings, task: Task,
               loss: Callable[..., Tensor]) -> int:
        level = network.levels[task.level - 1]
        stage = settings.stage(task.level - 1)
        optimiser = torch.optim.Adam(level.parameters(), stage.learning_rate, weight_decay=stage.weight_decay)
        average = WeightAverage(level, settings.average) if settings.average else None
        network.eval()
        level.train()
        spent, steps = 0.0, 0
        for batch in self._batches(settings, task):
            began = time.process_time()
            rate = stage.learning_rate * (1 + math.cos(math.pi * spent / task.seconds)) / 2
            optimiser.param_groups[0]["lr"] = rate * min(1.0, (steps + 1) / _WARM_UP)
            self._losses(network, batch, settings, task, loss).mean().backward()
            torch.nn.utils.clip_grad_norm_(level.parameters(), 1.0)
            optimiser.step()
            optimiser.zero_grad()
            steps += 1
            if average is not None:
                average.update(steps)
            spent += time.process_time() - began
            if spent >= task.seconds:
                break
        if average is not None:
            level.load_state_dict(average.tensors)
        return steps

    def _batches(self, settings: TrainSettings, task: Task) -> Iterator[AnyBatch]:
        training = open_data(self._data, settings).training(Path(), settings, task.level - 1)
        for epoch in range(1_000_000):
            training.set_epoch(epoch)
            yield from training

    def _losses(self, network: OctNetFusion, batch: AnyBatch, settings: TrainSettings, task: Task,
                loss: Callable[..., Tensor]) -> Tensor:
        example = self._example(batch)
        crop = settings.stage(task.level - 1).crop
        with torch.autocast("cpu", torch.bfloat16, enabled=self._precision == "bfloat16"):
            if crop is None:
                raw = network.run(example.inputs, frozen=task.level - 1)[-1].raw
                return loss(raw, example.target, "none")
            size = crop // TREE_WIDTH
            corners = draw_corners(example.target.structure, size, task.seed, batch.epoch, batch.keys)
            return crop_losses(network, example, task.level - 1, corners, size, loss)

    @torch.no_grad()
    def _validate(self, network: OctNetFusion, settings: TrainSettings, variant: str) -> dict[str, float]:
        resolutions = settings.up_to(settings.levels - 1, self._manifest.to_dict())
        tau = self._manifest.normalise.extent / resolutions[-1] * self._manifest.truncation_voxels
        validator = Validator(network.output, network.encoding, tau)
        for batch in ShardDataset(self._data, "val", resolutions, settings.encoding, variant=variant,
                                  shuffle=False, uneven="exact"):
            example = self._example(batch)
            validator.add(network(example.inputs)[-1], example)
        found = validator.means(list)
        assert found is not None
        return {"mad": found.mad, "iou": found.iou, "f_score": found.f_score}

    def _example(self, batch: AnyBatch) -> Example:
        return make_example(batch, Output.TSDF, Output.TSDF, torch.device("cpu"))


def print_table(results: list[dict[str, Any]], inputs: list[str]) -> None:
    """A line a row, in the order of the first input's MAD."""
    table = Table(title="equal processor time; mean over seeds ± standard deviation")
    for heading in ("row", "seeds", "parameters", "steps", *(f"{name}: MAD mm, IoU, F" for name in inputs)):
        table.add_column(heading, justify="left" if heading == "row" else "right")
    rows: dict[str, list[dict[str, Any]]] = {}
    for found in results:
        rows.setdefault(found["row"], []).append(found)
    for row, runs in sorted(rows.items(), key=lambda row: _mean_mad(row[1], inputs[0])):
        steps = statistics.fmean(run["steps"] for run in runs)
        table.add_row(row, str(len(runs)), f"{runs[0]['parameters']:,}", f"{steps:.0f}",
                      *(", ".join((_spread(runs, name, "mad", 2), _spread(runs, name, "iou", 3),
                                   _spread(runs, name, "f_score", 3))) for name in inputs))
    Console(width=200).print(table)


def _mean_mad(runs: list[dict[str, Any]], name: str) -> float:
    return statistics.fmean(run["scores"][name]["mad"] for run in runs)


def _spread(runs: list[dict[str, Any]], name: str, figure: str, digits: int) -> str:
    values = [run["scores"][name][figure] for run in runs]
    spread = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):.{digits}f}{spread}"


def main() -> None:
    """Train what is missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data")
    parser.add_argument("--results", type=Path, required=True, help="a line of JSON is appended for each run")
    parser.add_argument("--rows", nargs="*", choices=list(ROWS), default=list(ROWS)[:12])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--seconds", type=float, default=200)
    parser.add_argument("--level", type=int, default=1)
    parser.add_argument("--run", help="what levels from the second on stand on")
    parser.add_argument("--precision", choices=["float32", "bfloat16"], default="float32")
    parser.add_argument("--inputs", nargs="+", help="those to validate with; the first one sorts the rows")
    arguments = parser.parse_args()
    if (arguments.level == 1) != (arguments.run is None):
        parser.error("--run belongs to levels from the second on")
    torch.set_num_threads(1)
    lines = arguments.results.read_text().splitlines() if arguments.results.exists() else []
    results = [json.loads(line) for line in lines]
    done = {(found["row"], found["seed"]) for found in results}
    manifest = Manifest.from_dict(load_dataset(arguments.data).manifest)
    inputs = arguments.inputs or [variant.name for variant in manifest.inputs]
    bench = Bench(arguments.data, inputs, arguments.run, arguments.precision)
    todo = [Task(row, seed, arguments.level, arguments.seconds) for seed in arguments.seeds
            for row in arguments.rows if (row, seed) not in done]
    for task in track(todo, "training", console=Console(stderr=True), disable=not todo):
        results.append(bench.run(task))
        with arguments.results.open("a") as file:
            file.write(json.dumps(results[-1]) + "\n")
    print_table(results, inputs)


if __name__ == "__main__":
    main()
