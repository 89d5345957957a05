"""Training a level on boxes around the surface instead of whole grids.

The levels before run on the whole grid, without gradients, so that what they carry up into the box is what
it always is. Only the level in training sees a box, with zeros around it. Near its faces that is not what it
will see in the whole grid, so the outer voxels of a box, but for those at the grid's own faces, have no loss.
Voxels whose receptive field lies in the box come out as in the whole grid.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from ocnf_data.arrays import I64
from ocnf_data.errors import OcnfError
from ocnf_data.octree.bits import TREE_WIDTH
from ocnf_model.network import OctNetFusion
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.crop import crop
from ocnf_model.octree.structure import Structure
from ocnf_model.training.batches import Example

ALIGNMENT = 4
"""Trees: a corner's multiple, so that two poolings join the same voxels as in the whole grid."""
MARGIN = 2
"""Trees, 16 voxels, along a face within the grid that have no loss."""


def draw_corners(truth: Structure, size: int, seed: int, epoch: int, keys: Sequence[str],
                 boxes: int = 1) -> I64:
    """Corners (N, B, 3), in trees along (z, y, x), of boxes around divided trees of each ground truth.

    A pure function of (seed, epoch, key, number of the box) and the ground truth.

    Args:
        truth: where the surface is.
        size: trees along each axis.
        seed: seed of the run.
        epoch: number of the epoch, from 0.
        keys: (B,) keys of the samples, or other texts where a key is met twice in an epoch.
        boxes: N, how many of each sample; more do not change the first.

    Raises:
        OcnfError: the box is larger than the grid.
    """
    grid = np.array(truth.grid)
    if (grid < size).any():
        raise OcnfError("the crop is larger than the grid", where="train", field="crop",
                        found=size * TREE_WIDTH, expected=f"at most {TREE_WIDTH * grid.min()}")
    corners = np.empty((boxes, len(keys), 3), np.int64)
    for b, key in enumerate(keys):
        divided = np.flatnonzero(truth.trees[b, ..., 0].reshape(-1) & np.uint64(1))
        if not len(divided):
            divided = np.arange(grid.prod())
        for n in range(boxes):
            name = f"ocnf crop {seed} {epoch} {key}" + (f" {n}" if n else "")
            number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
            centre = np.array(np.unravel_index(divided[number % len(divided)], truth.grid))
            nearest = ALIGNMENT * np.round((centre - (size - 1) / 2) / ALIGNMENT).astype(np.int64)
            corners[n, b] = np.clip(nearest, 0, grid - size)
    return corners


def crop_losses(network: OctNetFusion, example: Example, level: int, corners: I64, size: int,
                loss: Callable[..., Tensor], weights: OctreeBatch | None = None) -> Tensor:
    """The loss of each sample, (B,): the mean over its boxes, of each over its inner voxels.

    Args:
        network: the levels before `level` run without gradients.
        example: inputs and ground truth on whole grids.
        level: number of the level, from 0.
        corners: (N, B, 3) in trees.
        size: trees along each axis.
        loss: a function of (prediction, target, weights=) that gives a mean over voxels.
        weights: of the voxels of whole grids, for the loss.
    """
    with torch.no_grad():
        before = network.run(example.inputs, levels=level)[-1] if level else None
        x = network.level_input(before, example.inputs, level)
    grid, losses = np.array(x.structure.grid), []
    for of_samples in corners:
        box, target = (crop(whole, of_samples, (size,) * 3) for whole in (x, example.target))
        raw = network.levels[level](box).raw
        losses.append(torch.stack([
            _inner_loss(raw, target, b, corner, grid, size, loss, weights)
            for b, corner in enumerate(of_samples)]))
    return torch.stack(losses).mean(0)  # (N, B) -> (B,)


def _inner_loss(raw: OctreeBatch, target: OctreeBatch, b: int, corner: I64, grid: I64, size: int,
                loss: Callable[..., Tensor], weights: OctreeBatch | None) -> Tensor:
    """The loss of box `b` without what lies along a face within the grid."""
    low = np.where(corner == 0, 0, MARGIN)
    high = np.where(corner + size == grid, size, size - MARGIN)
    depth, height, width = (int(n) for n in high - low)
    inner, shape = low[None], (depth, height, width)
    weighed = None if weights is None else crop(weights, (corner + low)[None], shape, [b])
    result: Tensor = loss(crop(raw, inner, shape, [b]), crop(target, inner, shape, [b]), weights=weighed)
    return result
