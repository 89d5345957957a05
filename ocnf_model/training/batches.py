"""Turn the loader's batches into what the network and the losses take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ocnf_data.loading.dataset import Batch, Octrees
from ocnf_data.octree import GridOctree
from ocnf_model.network import Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.structure import Structure


@dataclass(frozen=True, eq=False)
class Example:
    """What a level is trained or judged on.

    Attributes:
        inputs: encodings of this level and those before, coarse to fine; and of the next, where it is read.
        target: ground truth of this level, TSDF / tau or occupancy, on its own structure.
    """

    inputs: list[OctreeBatch]
    target: OctreeBatch

    @property
    def encoded(self) -> OctreeBatch:
        """The input of the target's resolution."""
        return next(encoded for encoded in self.inputs if encoded.shape == self.target.shape)


@dataclass(frozen=True, eq=False)
class GridBatch:
    """A batch whose octrees are in hand: for what does not come from shards, and for grids that are no cubes.

    Attributes:
        epoch, step, keys, repeat: as of a `Batch`.
        inputs: for each level, coarse to fine, the octrees of the B samples.
        targets: octrees of the last level's ground truth, B of them; what the network makes, not derived.
    """

    epoch: int
    step: int
    keys: tuple[str, ...]
    repeat: tuple[bool, ...]
    inputs: Sequence[Sequence[GridOctree]]
    targets: Sequence[GridOctree]

    def __len__(self) -> int:
        """Number of samples, B."""
        return len(self.keys)

    @property
    def draws(self) -> tuple[str, ...]:
        """What anything drawn for a sample is drawn by: its key."""
        return self.keys


AnyBatch = Batch | GridBatch


def to_octree_batch(octrees: Octrees, device: torch.device | str = "cpu") -> OctreeBatch:
    """The loader's octrees, which are on the CPU, with their values as float32 on a device."""
    structure = Structure(octrees.trees.numpy().view(np.uint64))
    return OctreeBatch(structure, replace(octrees, data=octrees.data.to(device)).to_float())


def make_example(batch: AnyBatch, output: Output, target: str, device: torch.device) -> Example:
    """The inputs of all the batch's resolutions, and the finest ground truth there is.

    Args:
        batch: resolutions coarse to fine.
        output: what the network makes.
        target: what the data set holds, `tsdf` or `occupancy`; occupancy is derived from a TSDF.
        device: where the values are put.
    """
    if isinstance(batch, GridBatch):
        grids = [OctreeBatch.from_grids(octrees).to(device) for octrees in batch.inputs]
        return Example(grids, OctreeBatch.from_grids(batch.targets).to(device))
    inputs = [to_octree_batch(octrees, device) for octrees in batch.inputs.values()]
    truth = to_octree_batch(list(batch.targets.values())[-1], device)
    if output is Output.OCCUPANCY and target == Output.TSDF:
        truth = truth.with_features((truth.features < 0).to(truth.features.dtype))
    return Example(inputs, truth)

