"""What each setting is worth: rows of settings, each trained for the time that the paper's network needs.

    python tools/bench/ablate.py OUT --results ablation.jsonl --steps 250 --seeds 0 1 2
    python tools/bench/ablate.py OUT --results crops.jsonl --level 2 --run RUN --rows whole crop64

A row's steps are those of the first one, divided by how much longer one of its steps takes: the median of
pairs of steps on the same samples, in turn, so that what else the machine does changes little. Reading does
not count: data loaders read at the same time. The learning rate falls by a cosine over the row's steps.
Training draws from all inputs of the data set alike, validation is the data set's split `val`. Levels from
the second on begin with the first levels of RUN, and with the weights of the level before. Finished rows are
read from the results, so that a stopped call can go on.
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
from train import endless

from ocnf_data import ShardDataset
from ocnf_data.manifest import Manifest
from ocnf_data.octree.bits import TREE_WIDTH
from ocnf_data.shards import load_dataset
from ocnf_model.checkpoint import load_run
from ocnf_model.header import Architecture
from ocnf_model.losses import Pair
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.training.average import WeightAverage
from ocnf_model.training.batches import AnyBatch, Example, make_example
from ocnf_model.training.crops import crop_losses, draw_corners
from ocnf_model.training.data import open_data
from ocnf_model.training.objective import objective
from ocnf_model.training.settings import TrainSettings, read_settings
from ocnf_model.training.validation import Validator

_BATCH = {1: 2}  # samples a step; 1 at later levels
_RATE = {1: 1e-3}  # the learning rate at first; 5e-4 at later levels
_WARM_UP = 20  # steps
_COMPARED = 12  # steps of two rows in turn, the first two of which do not count


def log_l1_loss(prediction: OctreeBatch, target: OctreeBatch, reduction: str = "mean",
                weights: OctreeBatch | None = None) -> Tensor:
    """L1 of sign(t) log(1 + |t|), t in voxels of the truncation, as SG-NN (Dai et al. 2020) has it."""
    pair = Pair.of(prediction, target)
    scaled = [torch.sign(t) * torch.log1p(3 * t.abs()) for t in (pair.prediction, pair.target)]
    costs = pair.weighed((scaled[0] - scaled[1]).abs(), weights)
    sums = pair.sum_over_voxels(costs)  # (B, 1)
    return sums.mean(1) / math.prod(pair.structure.shape)


ROWS: dict[str, dict[str, Any]] = {
    "paper": {},
    "batch_norm": {"normalise": "batch"},
    "residual": {"residual": True},
    "context": {"context": 128},
    "wide": {"channels": [24, 48, 96]},
    "add": {"join": "add"},
    "truncated_l1": {"loss": "truncated_l1"},
    "log_l1": {"loss": "log_l1"},
    "sign_l1": {"wrong_sign": 3.0},
    "truncated_sign": {"loss": "truncated_l1", "wrong_sign": 3.0},
    "blend": {"blend": True},
    "symmetries": {"augment": "all"},
    "average": {"average": 0.98},
    "norm_context": {"normalise": "batch", "context": 128},
    "norm_average": {"normalise": "batch", "average": 0.98},
    "whole": {},
    "crop64": {"crop": 64},
    "crop96": {"crop": 96},
    "crop128": {"crop": 128},
}
"""Settings of each row that differ from the paper's network and its L1 loss."""
_OF_CROPS = ("whole", "crop64", "crop96", "crop128")


@dataclass(frozen=True)
class Task:
    """One run of the bench.

    Attributes:
        row: name in `ROWS`.
        seed: of the weights and of the order of the samples.
        level: which one is trained, from 1.
        base: row whose time is the measure.
        steps: steps of that one.
    """

    row: str
    seed: int
    level: int
    base: str
    steps: int


class Training:
    """A row in training, step by step.

    Args:
        network: the network, of which the last level is trained.
        settings: settings of the row.
        batches: samples without end.
        loss: its loss.
    """

    def __init__(self, network: OctNetFusion, settings: TrainSettings, batches: Iterator[AnyBatch],
                 loss: Callable[..., Tensor]) -> None:
        self.network, self.settings = network, settings
        self._batches, self._loss = batches, loss
        self._last = settings.levels - 1
        self._stage = settings.stage(self._last)
        self._level = network.levels[self._last]
        self._optimiser = torch.optim.Adam(self._level.parameters(), self._stage.learning_rate,
                                           weight_decay=self._stage.weight_decay)
        self._average = WeightAverage(self._level, settings.average) if settings.average else None
        self._done = 0
        network.eval()
        self._level.train()

    def step(self, n_steps: int) -> float:
        """One step of `n_steps`; the processor seconds that it took, without reading."""
        batch = next(self._batches)
        began = time.process_time()
        warm = min(1.0, (self._done + 1) / _WARM_UP)
        self._optimiser.param_groups[0]["lr"] = self._stage.rate(self._done, n_steps) * warm
        self._losses(batch).mean().backward()
        torch.nn.utils.clip_grad_norm_(self._level.parameters(), 1.0)
        self._optimiser.step()
        self._optimiser.zero_grad()
        self._done += 1
        if self._average is not None:
            self._average.update(self._done)
        return time.process_time() - began

    def finish(self) -> None:
        """Take the averaged weights, if there are some."""
        if self._average is not None:
            self._level.load_state_dict(self._average.tensors)

    def _losses(self, batch: AnyBatch) -> Tensor:
        example, crop = _example(batch), self._stage.crop
        with torch.autocast("cpu", torch.bfloat16, enabled=self.settings.precision == "bfloat16"):
            if crop is None:
                raw = self.network.run(example.inputs, self._last, self._last + 1)[-1].raw
                return self._loss(raw, example.target, "none")
            size, seed = crop // TREE_WIDTH, self.settings.seed
            corners = draw_corners(example.target.structure, size, seed, batch.epoch, batch.keys)
            return crop_losses(self.network, example, self._last, corners, size, self._loss)


def _example(batch: AnyBatch) -> Example:
    return make_example(batch, Output.TSDF, Output.TSDF, torch.device("cpu"))


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
        """Steps, their cost, and for each input the figures of validation."""
        run = self._begin(task.row, task)
        cost = 1.0 if task.row == task.base else self._cost(run, self._begin(task.base, task))
        run = self._begin(task.row, task)  # anew
        steps = round(task.steps / cost)
        for _ in range(steps):
            run.step(steps)
        run.finish()
        scores = {name: self._validate(run.network.eval(), run.settings, name) for name in self._inputs}
        parameters = sum(p.numel() for p in run.network.levels[task.level - 1].parameters())
        return {**asdict(task), "steps": steps, "cost": cost, "scores": scores, "parameters": parameters}

    def _cost(self, ours: Training, theirs: Training) -> float:
        """How much longer a step of ours takes than one of theirs."""
        ratios = []
        for n in range(_COMPARED):  # whoever comes second finds a warmer machine
            if n % 2:
                mine, other = ours.step(_COMPARED), theirs.step(_COMPARED)
            else:
                other, mine = theirs.step(_COMPARED), ours.step(_COMPARED)
            ratios.append(mine / other)
        first, second = (statistics.median(ratios[start::2]) for start in (2, 3))
        return math.sqrt(first * second)

    def _begin(self, row: str, task: Task) -> Training:
        fields = dict(ROWS[row])
        own_loss = log_l1_loss if fields.get("loss") == "log_l1" else None
        if own_loss is not None:
            del fields["loss"]
        stage = {"batch_size": _BATCH.get(task.level, 1), "accumulate": 1, "crop": fields.pop("crop", None),
                 "learning_rate": _RATE.get(task.level, 5e-4), "decay": "cosine"}
        stages: list[dict[str, Any]] = [{}] * (task.level - 1) + [stage]
        parts = [{"variant": variant.name} for variant in self._manifest.inputs]
        settings = read_settings({**fields, "levels": task.level, "seed": task.seed, "stages": stages,
                                  "precision": self._precision, "mixture": parts,
                                  "samples_per_epoch": 2000}, row)
        settings = settings.resolved(self._manifest.to_dict(), None, self._data)
        network = self._network(settings, task)
        return Training(network, settings, self._batches(settings, task),
                        own_loss or objective(settings, network.output))

    def _network(self, settings: TrainSettings, task: Task) -> OctNetFusion:
        torch.manual_seed(task.seed)
        network = Architecture.of(settings).network(settings.levels)
        if self._run is not None:
            before = load_run(self._run)
            for ours, theirs in zip(network.levels[:-1], before.levels, strict=False):
                ours.load_state_dict(theirs.state_dict())
            network.start_from_previous(task.level - 1)
        return network

    def _batches(self, settings: TrainSettings, task: Task) -> Iterator[AnyBatch]:
        return endless(open_data(self._data, settings).training(Path(), settings, task.level - 1))

    @torch.no_grad()
    def _validate(self, network: OctNetFusion, settings: TrainSettings, variant: str) -> dict[str, float]:
        resolutions = settings.up_to(settings.levels - 1, self._manifest.to_dict())
        tau = self._manifest.normalise.extent / resolutions[-1] * self._manifest.truncation_voxels
        validator = Validator(network.output, network.encoding, tau)
        for batch in ShardDataset(self._data, "val", resolutions, settings.encoding, variant=variant,
                                  shuffle=False, uneven="exact"):
            example = _example(batch)
            validator.add(network(example.inputs)[-1], example)
        found = validator.means(list)
        assert found is not None
        return {"mad": found.mad, "iou": found.iou, "f_score": found.f_score}


def print_table(results: list[dict[str, Any]], inputs: list[str]) -> None:
    """A line a row, in the order of the first input's MAD."""
    table = Table(title="equal time; mean over seeds ± standard deviation")
    for heading in ("row", "seeds", "parameters", "cost of a step", "steps",
                    *(f"{name}: MAD mm, IoU, F" for name in inputs)):
        table.add_column(heading, justify="left" if heading == "row" else "right")
    rows: dict[str, list[dict[str, Any]]] = {}
    for found in results:
        rows.setdefault(found["row"], []).append(found)
    for row, runs in sorted(rows.items(), key=lambda row: _mean_mad(row[1], inputs[0])):
        cost, steps = (statistics.fmean(run[field] for run in runs) for field in ("cost", "steps"))
        table.add_row(row, str(len(runs)), f"{runs[0]['parameters']:,}", f"{cost:.2f}", f"{steps:.0f}",
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
    parser.add_argument("--rows", nargs="*", choices=list(ROWS),
                        default=[row for row in ROWS if row not in _OF_CROPS])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--steps", type=int, default=250, help="of the first row")
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
    todo = [Task(row, seed, arguments.level, arguments.rows[0], arguments.steps) for seed in arguments.seeds
            for row in arguments.rows if (row, seed) not in done]
    for task in track(todo, "training", console=Console(stderr=True), disable=not todo):
        results.append(bench.run(task))
        with arguments.results.open("a") as file:
            file.write(json.dumps(results[-1]) + "\n")
    print_table(results, inputs)


if __name__ == "__main__":
    main()
