"""What evaluation runs: VolFus from a stored input, and the network level by level."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from ocnf_data.encodings import Encoding
from ocnf_data.octree import GridOctree
from ocnf_model.baselines import volfus_from_encoding
from ocnf_model.devices import Precision, autocast, is_fast, memory_errors, wait_for
from ocnf_model.network import LevelOutput, OctNetFusion
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.ops.blend import plain_tsdf


def stored_volfus(octree: GridOctree, encoding: Encoding) -> GridOctree:
    """VolFus's TSDF / tau from a stored input.

    It is exact (to the rounding of storage, 1/255) from `tsdf` and `tdf_occupancy`. From `histogram` it is an
    approximation, the mean of the bins, the last one taken at tau: a vote between 0.875 tau and 1.125 tau in
    front of a surface is split between two bins, which hides on which side of tau it was.
    """
    if encoding is not Encoding.HISTOGRAM:
        return volfus_from_encoding(octree, encoding)
    return octree.with_data(plain_tsdf(torch.from_numpy(octree.data), encoding).numpy())


@dataclass(frozen=True, eq=False)
class Reached:
    """What the network has after one of its levels.

    Attributes:
        reconstruction: reconstruction of that level, on the CPU.
        seconds: since the inputs were on the device: this level and all before it, structure work included.
    """

    reconstruction: OctreeBatch
    seconds: float


@torch.no_grad()
def run_levels(network: OctNetFusion, inputs: Sequence[OctreeBatch], device: torch.device,
               levels: int | None = None) -> Iterator[Reached]:
    """Run the network, a level a step; inputs coarse to fine. The clock stands while a step is looked at.

    `levels` of them run; None: one for each input, all at most. It computes in the network's
    `precision` where the device is fast in that; results are float32.
    """
    inputs = [encoded.to(device) for encoded in inputs]
    precision = network.precision if is_fast(network.precision, device) else Precision.FLOAT32
    before: LevelOutput | None = None
    seconds = 0.0
    wait_for(device)
    for level in range(min(len(inputs), len(network.levels)) if levels is None else levels):
        start = time.perf_counter()
        size = "x".join(map(str, inputs[level].shape))
        remedy = "lower the resolution" + (", or take --device cpu" if device.type != "cpu" else "")
        with memory_errors(f"the network at {size}", remedy), \
                autocast(precision, device):
            before = network.levels[level](network.level_input(before, inputs, level))
            wait_for(device)
        seconds += time.perf_counter() - start
        found = before.reconstruction.to("cpu")
        if found.features.dtype is torch.bfloat16:
            found = found.to(dtype=torch.float32)
        yield Reached(found, seconds)
