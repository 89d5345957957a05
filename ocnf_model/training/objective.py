"""What is minimised: the loss by the settings, and what a voxel counts in it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from torch import Tensor

from ocnf_model.losses import bce_loss, l1_loss, truncated_l1_loss
from ocnf_model.measures.regions import seen_by
from ocnf_model.network import Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.training.batches import Example
from ocnf_model.training.settings import Loss, TrainSettings

LOSSES: dict[Loss, Callable[..., Tensor]] = {Loss.L1: l1_loss, Loss.TRUNCATED_L1: truncated_l1_loss}


def objective(settings: TrainSettings, output: Output) -> Callable[..., Tensor]:
    """The loss of what a network makes: a function of (prediction, target, reduction, weights=)."""
    if output is Output.OCCUPANCY:
        return bce_loss
    return partial(LOSSES[settings.loss], wrong_sign=settings.wrong_sign)


def voxel_weights(settings: TrainSettings, output: Output, example: Example) -> OctreeBatch | None:
    """(L, 1) weights of voxels: 1 where an input view has measured, else `unseen`; None: 1 everywhere."""
    if settings.unseen == 1 or output is Output.OCCUPANCY:
        return None
    seen = seen_by(example.encoded, settings.encoding)
    assert seen is not None  # such settings are refused
    return seen.with_features(seen.features + settings.unseen * (1 - seen.features))
