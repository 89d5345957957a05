"""Seconds that a drawn sample costs at each level, beside a training step's share of one.

    python tools/bench/synthesis.py manifests/general.yaml --meshes ROOT --samples 20

"fresh" makes mesh, 80 views, ground truth and input; "again" is a later epoch of a season (`repeat`), whose
ground truth lies in the cache: the mesh, the input's views, and its fusion. A step is one batch of the
paper's size, divided by its samples: forward through all levels, loss, backward, Adam. All are CPU seconds of
one thread, so they compare whatever else the machine does: a worker process has one thread, and a step on n
cores takes about an n-th of its CPU seconds. They alternate, sample by sample.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numba
import torch
from rich.console import Console

from ocnf_data import SynthesisDataset, load_manifest
from ocnf_data.loading.batch import Batch
from ocnf_data.manifest.synthesis import Synthesis
from ocnf_data.synthesis.sources import Sources, open_sources
from ocnf_model.losses import l1_loss
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.training.batches import make_example
from ocnf_model.training.settings import TrainSettings

STAGES = ("fresh", "again", "step")


def measure(sources: Sources, level: int, n_samples: int) -> dict[str, float]:
    """Medians over the samples after the first, in seconds, of the level (from 0)."""
    resolutions = list(sources.manifest.resolutions[: level + 1])
    settings = TrainSettings()
    batch_size = settings.stage(level).batch_size
    network = OctNetFusion(levels=level + 1)
    optimiser = torch.optim.Adam(network.levels[level].parameters(), 1e-4)
    times: dict[str, list[float]] = {name: [] for name in STAGES}
    with tempfile.TemporaryDirectory() as cache:
        drawn = SynthesisDataset(sources, resolutions, "histogram", batch_size=batch_size, cache=cache,
                                 samples_per_epoch=(n_samples + 1) * batch_size)
        batches: dict[str, list[Batch]] = {}
        for number in range(n_samples + 1):
            for epoch, name in enumerate(("fresh", "again")):  # both of one season
                drawn.load_state_dict({**drawn.state_dict(), "epoch": epoch, "step": number})
                began = time.process_time()
                batches[name] = [next(iter(drawn))]
                times[name].append((time.process_time() - began) / batch_size)
            began = time.process_time()
            example = make_example(batches["fresh"][0], Output.TSDF, Output.TSDF, torch.device("cpu"))
            loss = l1_loss(network.run(example.inputs, frozen=level)[-1].raw, example.target)
            loss.backward()
            optimiser.step()
            optimiser.zero_grad()
            times["step"].append((time.process_time() - began) / batch_size)
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def main() -> None:
    """Print a line a level."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("manifest", type=Path)
    parser.add_argument("--meshes", type=Path)
    parser.add_argument("--samples", type=int, default=20)
    parser.add_argument("--levels", type=int, default=3)
    arguments = parser.parse_args()
    manifest = load_manifest(arguments.manifest)
    section = (manifest.synthesis or Synthesis()).model_copy(update={"repeat": 2})
    manifest = manifest.model_copy(update={"synthesis": section})
    sources = open_sources(manifest, manifest.meshes_root(arguments.meshes), "train")
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    console = Console()
    console.print("CPU seconds a sample, one thread, and drawing's share of a step's for repeat 1 / 4 / 16")
    for level in range(min(arguments.levels, len(manifest.resolutions))):
        median = measure(sources, level, arguments.samples)
        shares = [(median["fresh"] + (repeat - 1) * median["again"]) / repeat / median["step"]
                  for repeat in (1, 4, 16)]
        console.print(f"level {level + 1}, {manifest.resolutions[level]}³:",
                      ", ".join(f"{name} {median[name]:.3f}" for name in STAGES) + ";",
                      " / ".join(f"{share:.0%}" for share in shares), highlight=False)


if __name__ == "__main__":
    main()
