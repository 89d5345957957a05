"""Structure of its own against structure of the reconstruction: which voxels of the first level are split.

    python tools/bench/structure_head.py OUT --variant v4_n02 --seconds 120

Here a level splits where its reconstruction changes sign. Others (ocnn-pytorch, SG-NN) predict what is split
by a head of its own, with the binary cross entropy balanced between the two classes. The first level of a
trained network is trained on for the same processor time, once with its L1 loss alone, once with that head
beside it. The head splits as many voxels of each model as the reconstruction does, so that shares compare.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.ndimage import maximum_filter, minimum_filter
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from ocnf_data import ShardDataset
from ocnf_data.arrays import F32, Bool
from ocnf_model.checkpoint import load_run
from ocnf_model.losses import Pair, l1_loss
from ocnf_model.metrics import tsdf_overlap
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.training.batches import Example, make_example

_RESOLUTION = 64
_SHARE = 0.1  # of the cross entropy in the loss
_RATE = 3e-4  # at first, then down by a cosine


@dataclass(frozen=True)
class Figures:
    """Means over the models.

    Attributes:
        iou: of the reconstruction.
        by_reconstruction, by_head: shares of the voxels that the true surface splits that either splits.
        split: number of voxels that are split for each one that the true surface splits.
    """

    iou: float
    by_reconstruction: float
    by_head: float
    split: float


def near_surface(tsdf: F32) -> Bool:
    """Voxels (D, H, W) with one of the other sign among the 27 around: what `split_surface` splits."""
    inside = (tsdf < 0).astype(np.uint8)
    near: Bool = maximum_filter(inside, 3) != minimum_filter(inside, 3)
    return near


def examples(network: OctNetFusion, data: str, split: str, variant: str, epoch: int) -> Iterator[Example]:
    """Samples one by one; the one input of each is what the first level reads."""
    dataset = ShardDataset(data, split, network.reads([_RESOLUTION]), network.encoding, variant=variant,
                           uneven="exact", targets=[_RESOLUTION])
    dataset.set_epoch(epoch)
    for batch in dataset:
        example = make_example(batch, Output.TSDF, Output.TSDF, torch.device("cpu"))
        yield replace(example, inputs=[network.level_input(None, example.inputs, 0)])


def head_loss(logits: OctreeBatch, truth: OctreeBatch) -> Tensor:
    """Cross entropy over the voxels, either class with half of the weight."""
    near = near_surface(truth.to_dense()[0, 0].numpy())
    target = OctreeBatch.full(torch.from_numpy(near[None, None].astype(np.float32)))
    pair = Pair.of(logits, target)
    positive, total = float(near.sum()), float(near.size)
    weights = torch.where(pair.target > 0.5, total / (2 * positive), total / (2 * (total - positive)))
    costs = binary_cross_entropy_with_logits(pair.prediction, pair.target, weights, reduction="none")
    return pair.sum_over_voxels(costs).mean() / total


def train(network: OctNetFusion, head: nn.Linear | None, arguments: argparse.Namespace) -> int:
    """Train on for the given processor time; the number of steps."""
    level = network.levels[0].train()
    parameters = [*level.parameters(), *([] if head is None else head.parameters())]
    optimiser = torch.optim.Adam(parameters, _RATE)
    spent, steps = 0.0, 0
    while True:
        for example in examples(network, arguments.data, "train", arguments.variant, steps):
            began = time.process_time()
            optimiser.param_groups[0]["lr"] = _RATE * (1 + math.cos(math.pi * spent / arguments.seconds)) / 2
            found = level(example.inputs[-1])
            loss = l1_loss(found.raw, example.target)
            if head is not None:
                logits = found.features.with_features(head(found.features.features))
                loss = loss + _SHARE * head_loss(logits, example.target)
            loss.backward()
            optimiser.step()
            optimiser.zero_grad()
            steps += 1
            spent += time.process_time() - began
            if spent >= arguments.seconds:
                return steps


@torch.no_grad()
def measure(network: OctNetFusion, head: nn.Linear | None, arguments: argparse.Namespace) -> Figures:
    """The figures on the split `val`."""
    level = network.levels[0].eval()
    rows = []
    for example in examples(network, arguments.data, "val", arguments.variant, 0):
        found = level(example.inputs[-1])
        ours = near_surface(found.raw.to_dense()[0, 0].numpy())
        true = near_surface(example.target.to_dense()[0, 0].numpy())
        by_head = math.nan
        if head is not None:
            logits = found.features.with_features(head(found.features.features)).to_dense()[0, 0].numpy()
            chosen = np.argsort(-logits, axis=None, kind="stable")[: ours.sum()]
            by_head = true.ravel()[chosen].sum() / true.sum()
        rows.append((float(tsdf_overlap(found.raw, example.target).iou), (ours & true).sum() / true.sum(),
                     by_head, ours.sum() / true.sum()))
    return Figures(*np.mean(rows, axis=0).tolist())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data")
    parser.add_argument("--variant")
    parser.add_argument("--run", default="pretrained")
    parser.add_argument("--seconds", type=float, default=120)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table = Table(title=f"what is split of what the true surface splits, {_RESOLUTION}^3")
    for heading in ("loss", "steps", "IoU", "by the reconstruction", "by the head", "voxels split"):
        table.add_column(heading, justify="left" if heading == "loss" else "right")
    for name in ("as shipped", "L1", "L1 and cross entropy"):
        torch.manual_seed(0)
        network = load_run(arguments.run, 1).requires_grad_(True)
        head = nn.Linear(network.channels[0], 1) if name.endswith("entropy") else None
        steps = 0 if name == "as shipped" else train(network, head, arguments)
        found = measure(network, head, arguments)
        table.add_row(name, str(steps), f"{found.iou:.3f}", f"{found.by_reconstruction:.3f}",
                      "" if head is None else f"{found.by_head:.3f}", f"{found.split:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
