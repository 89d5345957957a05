"""What a network can be told to be: settings that are one of several words."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import TypeVar

from ocnf_data.errors import OcnfError

_Choice = TypeVar("_Choice", bound=StrEnum)
Widths = tuple[int, int, int]
"""Numbers of channels at the three resolutions within a level."""


class Join(StrEnum):
    """How the decoder takes in the encoder's features of the same resolution."""

    CONCAT = "concat"
    """Side by side (the paper)."""
    ADD = "add"
    """Summed (the published training script)."""


class Carry(StrEnum):
    """What the structure module hands to the next level."""

    FEATURES = "features"
    """The features that the output head reads (the paper)."""
    RECONSTRUCTION = "reconstruction"
    """The reconstruction alone (the published code)."""


class Output(StrEnum):
    """What is reconstructed."""

    TSDF = "tsdf"
    """TSDF / tau, by a linear 1x1x1 head; negative inside."""
    OCCUPANCY = "occupancy"
    """Probability of being occupied, by a 3x3x3 head and a sigmoid."""

    @property
    def threshold(self) -> float:
        """Value that separates the two sides of the surface."""
        return 0.0 if self is Output.TSDF else 0.5


class Normaliser(StrEnum):
    """What comes between a 3x3x3 convolution and its ReLU."""

    NONE = "none"
    """Nothing, the convolution has a bias (the paper)."""
    BATCH = "batch"
    """Batch normalisation over the leaves (Ioffe and Szegedy 2015). In evaluation it is a fixed scale and
    shift of each channel, so that the network stays a local function of its input."""


def choice(kind: type[_Choice], field: str, value: str) -> _Choice:
    """The word as one of the enumeration.

    Raises:
        OcnfError: it is none of them.
    """
    if value not in tuple(kind):
        raise OcnfError("no such setting", where="OctNetFusion", field=field, found=value,
                        expected=" or ".join(kind))
    return kind(value)


def widths_at(level: int, channels: Widths, level_channels: Sequence[Widths] | None) -> Widths:
    """The channels of a level (from 0): its own, or else everyone's."""
    return level_channels[level] if level_channels is not None and level < len(level_channels) else channels
