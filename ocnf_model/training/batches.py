"""From the loader's batches to what the network and the losses take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ocnf_data.loading.dataset import Batch, Octrees, ShardDataset
from ocnf_model.network import Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.structure import Structure
from ocnf_model.training.settings import TrainSettings


@dataclass(frozen=True, eq=False)
class Example:
    """What a level is trained or judged on.

    Attributes:
        inputs: encodings of this level and those before, coarse to fine.
        target: ground truth of this level, TSDF / tau or occupancy, on its own structure.
    """

    inputs: list[OctreeBatch]
    target: OctreeBatch


def to_octree_batch(octrees: Octrees, device: torch.device | str = "cpu") -> OctreeBatch:
    """The loader's octrees, which are on the CPU, with their values as float32 on a device."""
    structure = Structure(octrees.trees.numpy().view(np.uint64))
    return OctreeBatch(structure, replace(octrees, data=octrees.data.to(device)).to_float())


def make_example(batch: Batch, output: Output, target: str, device: torch.device) -> Example:
    """The inputs of all the batch's resolutions, and the ground truth of the finest.

    Args:
        batch: resolutions coarse to fine.
        output: what the network makes.
        target: what the data set holds, `tsdf` or `occupancy`; occupancy is derived from a TSDF.
        device: for the values.
    """
    inputs = [to_octree_batch(octrees, device) for octrees in batch.inputs.values()]
    truth = to_octree_batch(list(batch.targets.values())[-1], device)
    if output is Output.OCCUPANCY and target == Output.TSDF:
        truth = truth.with_features((truth.features < 0).to(truth.features.dtype))
    return Example(inputs, truth)


def open_split(data: str, settings: TrainSettings, level: int, manifest: Mapping[str, Any], *,
               train: bool) -> ShardDataset:
    """The samples of a level (from 0), to train on or to validate with.

    Raises:
        OcnfError: the data set has not got them, or they are none.
    """
    resolutions = settings.resolutions or sorted(manifest["resolutions"])[: settings.levels]
    split = settings.train_split if train else settings.val_split
    shared: dict[str, Any] = {"variant": settings.variant, "categories": settings.categories,
                              "seed": settings.seed, "on_error": settings.on_error}
    wanted = data, split, list(resolutions[: level + 1]), settings.encoding
    if train:
        return ShardDataset(*wanted, **shared, batch_size=settings.stage(level).batch_size,
                            augment=settings.augment, buffer=settings.shuffle_buffer)
    return ShardDataset(*wanted, **shared, shuffle=False, uneven="exact")
