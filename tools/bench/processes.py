"""Training steps a second on one device: by one process, and by several that share it.

    python tools/bench/processes.py [MESH | CATEGORY] [--device cuda] [--processes 1 8] [--seconds 5]

`pretrained` is trained on with samples in hand, without a loader: level 1 on two whole grids, levels 2 and 3
on a box of 96 and 128 voxels. Every step makes the tables of its structures anew, as it has to for new
samples. A GPU that waits for them trains with several ranks (`torchrun --nproc-per-node 8`) so many times as
fast as with one.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from multiprocessing.synchronize import Barrier

import numba
import torch
from noisy_octrees import print_table, sample_octrees

from ocnf_data.encodings import Encoding
from ocnf_data.octree import TARGET, GridOctree
from ocnf_model.checkpoint import load_run
from ocnf_model.devices import Precision, autocast, wait_for
from ocnf_model.losses import truncated_l1_loss
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.training.batches import Example
from ocnf_model.training.crops import crop_losses, draw_corners

CASES = ((1, None, 2), (2, 96, 1), (3, 128, 1))
"""Level, side of the box in voxels, samples of a step."""
_SIDES = (64, 128, 256)
_barrier: Barrier


def meet(barrier: Barrier, threads: int) -> None:
    """Begin a process that measures together with others."""
    global _barrier
    _barrier = barrier
    torch.set_num_threads(threads)
    numba.set_num_threads(threads)


def steps_a_second(octrees: dict[tuple[str, int], GridOctree], case: tuple[int, int | None, int],
                   device_name: str, seconds: float) -> float:
    """Steps of one process a second, while the others take theirs."""
    level, crop, n = case
    device = torch.device(device_name)
    network = load_run("pretrained", level).to(device).train().requires_grad_(True)

    def step() -> None:
        inputs = [OctreeBatch.from_grids([octrees[str(Encoding.HISTOGRAM), side]] * n).to(device)
                  for side in _SIDES[:level]]
        target = OctreeBatch.from_grids([octrees[TARGET, _SIDES[level - 1]]] * n).to(device)
        with autocast(Precision.BFLOAT16, device):
            if crop is None:
                losses = truncated_l1_loss(network.run(inputs, frozen=level - 1)[-1].raw, target, "none")
            else:
                corners = draw_corners(target.structure, crop // 8, 0, 0, ["sample"])
                losses = crop_losses(network, Example(inputs, target), level - 1, corners, crop // 8,
                                     truncated_l1_loss)
        losses.mean().backward()
        wait_for(device)

    step()
    _barrier.wait()
    began, done = time.monotonic(), 0
    while time.monotonic() < began + seconds:
        step()
        done += 1
    return done / (time.monotonic() - began)


def main() -> None:
    """Print the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("mesh", nargs="?", default="chair")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=5)
    options = parser.parse_args()
    octrees = sample_octrees(options.mesh, _SIDES)
    context, found = get_context("spawn"), []
    for n in options.processes:
        barrier = context.Barrier(n, timeout=600)  # seconds: one that fails leaves no others waiting
        with ProcessPoolExecutor(n, context, meet, (barrier, options.threads)) as pool:
            found.append([sum(pool.map(steps_a_second, [octrees] * n, [case] * n, [options.device] * n,
                                       [options.seconds] * n)) * case[2] for case in CASES])
    print_table("samples a second, by processes | " + " | ".join(map(str, options.processes)),
                [[f"{_SIDES[level - 1]}³" + (f", crop {crop}" if crop else ""),
                  *(f"{rates[i]:.2f}" for rates in found)] for i, (level, crop, _) in enumerate(CASES)])


if __name__ == "__main__":
    main()
