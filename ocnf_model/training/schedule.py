"""How one level is trained: for how long, by what steps, on how much of each sample."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated

from pydantic import Field

from ocnf_data.files.validation import Int, Positive, Real, Strict


class Decay(StrEnum):
    """How the learning rate goes on from its first value."""

    NONE = "none"
    """The learning rate stays constant (the paper)."""
    COSINE = "cosine"
    """Half a cosine down to 0 at the end of the level, which short runs profit from."""


class Stage(Strict):
    """How one level is trained; the defaults are those of the later levels."""

    epochs: Positive = 25
    """Passes over the training split."""
    batch_size: Positive = 1
    """Samples a batch, for each process."""
    accumulate: Positive = 4
    """Batches whose gradients are averaged for one step; fewer at the end of an epoch."""
    learning_rate: Annotated[Real, Field(gt=0)] = 1e-4
    """The learning rate of Adam, at the first step."""
    decay: Decay = Decay.NONE
    """How the learning rate goes on."""
    weight_decay: Annotated[Real, Field(ge=0)] = 1e-4
    """L2 penalty: this times the weights is added to the gradient."""
    crop: Annotated[Int, Field(ge=64, multiple_of=32)] | None = None
    """Voxels along each axis of the box around the surface that a sample is trained on, in multiples of 32;
    None for the whole grid (the paper). Validation takes the whole grid."""
    crops: Positive = 1
    """Boxes of each sample. What is made on the whole grid serves all of them: the sample itself, the tables
    of its structures, and what the levels before carry up."""

    freeze_after: Annotated[Int, Field(ge=0)] | None = None
    """Epochs after which batch normalisation keeps its statistics, so that a level is trained as it is used;
    0 for a level that begins with another's. None for never."""

    def rate(self, done: int, steps: int) -> float:
        """The learning rate of a step.

        Args:
            done: steps before it.
            steps: number of steps in the whole level.
        """
        if self.decay is Decay.NONE:
            return self.learning_rate
        return self.learning_rate * (1 + math.cos(math.pi * done / steps)) / 2
