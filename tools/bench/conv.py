"""Octree convolution beside dense convolution, and the whole network, on real structures.

    python tools/bench/conv.py [MESH | CATEGORY] [--levels 3] [--no-dense] [--device cuda]

The structure is that of 4 noisy views as a histogram at 256^3 (`--resolution`). Without a mesh, a procedural
chair. Times are medians of several calls, tables of the structure made before, their making on a line of its
own. Peak memory is that of a fresh process that does this one thing, above what the imports take. The network
is the shipped one, so that the leaves it adds near its surface are as many as in use.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numba
import torch
from noisy_octrees import print_table, sample_octrees
from torch.nn.functional import conv3d

from ocnf_data.encodings import Encoding
from ocnf_data.octree import GridOctree
from ocnf_model import OctNetFusion, OctreeBatch, OctreeConv3d
from ocnf_model.checkpoint import open_run
from ocnf_model.losses import l1_loss
from ocnf_model.octree.neighbours import Neighbours
from ocnf_model.octree.structure import Structure

CHANNELS = ((32, 32), (16, 32), (64, 16))


def main() -> None:
    """Print the tables, or be the fresh process that runs one of `WORKS`."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("mesh", nargs="?", default="chair")
    parser.add_argument("--resolution", type=int, default=256)
    parser.add_argument("--levels", type=int, default=3, help="of the network, the last at --resolution")
    parser.add_argument("--no-dense", action="store_true", help="leave the dense convolutions out")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--work", nargs=2, metavar=("NAME", "FOLDER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    numba.set_num_threads(min(options.threads, numba.get_num_threads()))
    torch.manual_seed(0)
    if options.work:
        print(peak_of(WORKS[options.work[0]], Path(options.work[1]), torch.device(options.device)))
        return
    resolutions = tuple(options.resolution >> shift for shift in reversed(range(options.levels)))
    octrees = sample_octrees(options.mesh, resolutions)
    inputs = [octrees[str(Encoding.HISTOGRAM), resolution] for resolution in resolutions]
    print(f"{Path(options.mesh).stem}: {inputs[-1]}, {options.threads} threads, {options.device}\n")
    with tempfile.TemporaryDirectory() as folder:
        for level, octree in enumerate(inputs):
            octree.write_oc(Path(folder) / f"{level}.oc")
        convolution_table(inputs[-1], folder, options)
        network_table(inputs, folder, options)


def convolution_table(octree: GridOctree, folder: str, options: argparse.Namespace) -> None:
    """Forward, forward and backward, and peak memory of single layers."""
    device, rows = torch.device(options.device), []
    batch = OctreeBatch.from_grids([octree]).to(device)
    for into, out in CHANNELS:
        layer = OctreeConv3d(into, out).to(device)
        x = batch.with_features(torch.randn(batch.n_leaves, into, device=device))
        forward = seconds(lambda layer=layer, x=x: infer(layer, x), device)  # type: ignore[misc]
        both = seconds(lambda layer=layer, x=x: train(layer, x), device)  # type: ignore[misc]
        gflops = 2 * 27 * into * out * batch.n_leaves / forward / 1e9
        dense = None if options.no_dense else dense_seconds(into, out, batch.shape, device)
        rows.append([f"{into} -> {out}", f"{dense:.2f}" if dense else "-", f"{forward:.3f}",
                     f"{dense / forward:.1f}" if dense else "-", f"{gflops:.0f}", f"{both:.3f}",
                     f"{both / forward:.2f}", measured_apart(f"{into}-{out}", folder, options)])
    print_table("channels | dense s | octree s | ratio | GFLOP/s | + backward s | / forward | peak MB", rows)


def network_table(inputs: list[GridOctree], folder: str, options: argparse.Namespace) -> None:
    """The making of the tables, and all levels of the network, these included."""
    device = torch.device(options.device)
    trees = Structure.of_grids(inputs[-1:]).trees
    network = shipped(options.levels).to(device)
    n_leaves = 0

    def reconstruct() -> None:
        nonlocal n_leaves
        with torch.no_grad():
            *_, last = network([OctreeBatch.from_grids([octree]).to(device) for octree in inputs])
        n_leaves = last.n_leaves

    build, run = seconds(lambda: Neighbours.build(Structure(trees)), device), seconds(reconstruct, device)
    rows = [["neighbour tables", f"{build:.3f}", ""],
            [f"{options.levels} levels, {n_leaves:,} leaves at the last", f"{run:.2f}",
             measured_apart("network", folder, options)],
            ["training step, last level", "", measured_apart("training", folder, options)]]
    print_table("work | s | peak MB", rows)


def shipped(levels: int) -> OctNetFusion:
    """The shipped network; levels that it has not got begin with the weights of its last one."""
    run = open_run("pretrained")
    network = run.headers[0].architecture.network(levels).eval().requires_grad_(False)
    network.load_state_dict(run.network.state_dict(), strict=False)
    for level in range(len(run.headers), levels):
        network.start_from_previous(level)
    return network


def seconds(call: Callable[[], object], device: torch.device, repeat: int = 5) -> float:
    """The median of several calls, after a first one."""
    times = []
    for _ in range(repeat + 1):
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


@torch.no_grad()
def infer(layer: OctreeConv3d, x: OctreeBatch) -> None:
    """Forward only."""
    layer(x)


def train(layer: OctreeConv3d, x: OctreeBatch) -> None:
    """Forward and backward, for the features too."""
    features = x.features.detach().requires_grad_()
    y = layer(x.with_features(features)).features
    torch.autograd.grad(y, [features, *layer.parameters()], torch.ones_like(y))


@torch.no_grad()
def dense_seconds(into: int, out: int, shape: tuple[int, int, int], device: torch.device) -> float:
    """One dense convolution of the same size, after a small one."""
    weight = torch.randn(out, into, 3, 3, 3, device=device)
    conv3d(torch.randn(1, into, 16, 16, 16, device=device), weight, padding=1)
    x = torch.randn(1, into, *shape, device=device)
    start = time.perf_counter()
    conv3d(x, weight, padding=1)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def _one_layer(into: int, out: int) -> Callable[[list[OctreeBatch]], None]:
    def work(inputs: list[OctreeBatch]) -> None:
        x = inputs[-1]
        features = torch.randn(x.n_leaves, into, device=x.device)
        infer(OctreeConv3d(into, out).to(x.device), x.with_features(features))
    return work


def _network(inputs: list[OctreeBatch]) -> None:
    with torch.no_grad():
        shipped(len(inputs)).to(inputs[0].device)(inputs)


def _training_step(inputs: list[OctreeBatch]) -> None:
    network = shipped(len(inputs)).to(inputs[0].device).requires_grad_(True)
    result = network.run(inputs, frozen=len(inputs) - 1)[-1].raw
    l1_loss(result, inputs[-1].with_features(inputs[-1].features[:, :1])).backward()


WORKS: dict[str, Callable[[list[OctreeBatch]], None]] = {
    **{f"{into}-{out}": _one_layer(into, out) for into, out in CHANNELS},
    "network": _network,
    "training": _training_step,
}


def measured_apart(work: str, folder: str, options: argparse.Namespace) -> str:
    """Peak memory in MB of a piece of work, in a process of its own."""
    command = [sys.executable, __file__, "--work", work, folder, "--device", options.device,
               "--threads", str(options.threads)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def peak_of(work: Callable[[list[OctreeBatch]], None], folder: Path, device: torch.device) -> str:
    """Peak memory in MB above that of the imports: of the process, or on a GPU what PyTorch took there."""
    tiny = OctreeBatch.full(torch.zeros(1, 1, 8, 8, 8)).to(device)
    infer(OctreeConv3d(1, 1).to(device), tiny)  # loads what is loaded at first use
    before = resident_mb("VmRSS")
    grids = [GridOctree.read_oc(path) for path in sorted(folder.glob("*.oc"))]
    work([OctreeBatch.from_grids([grid]).to(device) for grid in grids])
    if device.type == "cuda":
        return f"{torch.cuda.max_memory_allocated(device) / 1e6:.0f}"
    return f"{resident_mb('VmHWM') - before:.0f}"


def resident_mb(field: str) -> float:
    """VmRSS, what the process holds now, or VmHWM, the most that it ever held."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) / 1e3
    raise KeyError(field)


if __name__ == "__main__":
    main()
