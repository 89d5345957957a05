"""Seconds and memory of a training step at each level, with the paper's batches, on a data set's samples.

    python tools/bench/train.py OUT --split train --levels 2 --steps 5

A step here is one batch: forward through the frozen levels and the one in training, loss, backward, Adam.
Reading is measured apart: workers do it at the same time. Every level is measured in its own process, for
the sake of its peak memory.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from ocnf_data.loading.batch import Batch
from ocnf_data.loading.epochs import EpochDataset
from ocnf_model.devices import pick_device
from ocnf_model.losses import l1_loss
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.training.batches import make_example
from ocnf_model.training.data import open_data
from ocnf_model.training.settings import TrainSettings


def endless(loader: EpochDataset) -> Iterator[Batch]:
    """The batches of one epoch after another."""
    for epoch in itertools.count():
        loader.set_epoch(epoch)
        yield from loader


def measure(arguments: argparse.Namespace) -> dict[str, float]:
    """One level: medians over the steps after the first, and the peak memory in GB."""
    settings = TrainSettings(levels=arguments.level, variant=arguments.variant, train_split=arguments.split,
                             encoding=arguments.encoding)
    data = open_data(arguments.data, settings)
    device = pick_device(arguments.device)
    level = arguments.level - 1
    network = OctNetFusion(arguments.encoding, arguments.level, checkpointing=arguments.checkpointing)
    network.to(device)
    optimiser = torch.optim.Adam(network.levels[level].parameters(), 1e-4, weight_decay=1e-4)
    batches = endless(data.training(Path(), settings, level))
    times: dict[str, list[float]] = {"read": [], "step": [], "leaves": []}
    for _ in range(arguments.steps + 1):
        began = time.perf_counter()
        batch = next(batches)
        times["read"].append(time.perf_counter() - began)
        began = time.perf_counter()
        example = make_example(batch, Output.TSDF, Output.TSDF, device)
        with torch.autocast(device.type, torch.bfloat16, enabled=arguments.bfloat16):
            output = network.run(example.inputs, frozen=level)[-1]
            loss = l1_loss(output.raw, example.target)
        loss.backward()
        optimiser.step()
        optimiser.zero_grad()
        loss.item()
        times["step"].append(time.perf_counter() - began)
        times["leaves"].append(output.raw.n_leaves)
    peak = torch.cuda.max_memory_allocated() if device.type == "cuda" \
        else 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    medians = {name: statistics.median(values[1:]) for name, values in times.items()}
    return {**medians, "batch": settings.stage(level).batch_size, "peak": peak / 1e9}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data")
    parser.add_argument("--split", default="train")
    parser.add_argument("--variant")
    parser.add_argument("--encoding", default="histogram")
    parser.add_argument("--levels", type=int, default=3)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--bfloat16", action="store_true")
    parser.add_argument("--checkpointing", action="store_true")
    parser.add_argument("--level", type=int, help=argparse.SUPPRESS)  # measure this one alone
    arguments = parser.parse_args()
    if arguments.level:
        print(json.dumps(measure(arguments)))
        return
    table = Table(title=f"training steps, {torch.get_num_threads()} threads")
    for title in ("level", "batch", "leaves a batch", "seconds a step", "samples a second", "reading, s",
                  "peak memory, GB"):
        table.add_column(title, justify="right")
    for level in range(1, arguments.levels + 1):
        found = subprocess.run([sys.executable, *sys.argv, "--level", str(level)], check=True,
                               stdout=subprocess.PIPE, text=True).stdout
        row = json.loads(found.splitlines()[-1])
        table.add_row(str(level), str(row["batch"]), f"{row['leaves']:,.0f}", f"{row['step']:.2f}",
                      f"{row['batch'] / row['step']:.2f}", f"{row['read']:.3f}", f"{row['peak']:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
