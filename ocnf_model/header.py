"""What a checkpoint says about itself: the network's architecture, what it was trained on, and how."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import torch
from pydantic import Field

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.records import Sha256
from ocnf_data.files.validation import Int, NotEmpty, Real, Strict, validate
from ocnf_model.network import Carry, Join, Normaliser, OctNetFusion, Output, Widths, widths_at
from ocnf_model.tensorfile import TensorKind

CHECKPOINT_SCHEMA: Final = 1
MAX_CHANNELS: Final = 4096
MAX_COUNT: Final = 2**53
Channels = Annotated[Int, Field(ge=1, le=MAX_CHANNELS)]
LevelChannels = Annotated[tuple[tuple[Channels, Channels, Channels], ...], NotEmpty]
Counted = Annotated[Int, Field(ge=1, le=MAX_COUNT)]


class Architecture(Strict):
    """What a network is, except for its number of levels: the arguments of `OctNetFusion`."""

    encoding: Encoding
    join: Join
    carry: Carry
    output: Output
    channels: tuple[Channels, Channels, Channels]
    band: Annotated[Real, Field(gt=0, le=1024)]
    context: Annotated[Int, Field(ge=0, le=MAX_CHANNELS)] = 0
    residual: bool = False
    normalise: Normaliser = Normaliser.NONE
    blend: bool = False
    finer: Annotated[Int, Field(ge=0, le=16)] = 0
    extra_channels: Annotated[Int, Field(ge=0, le=MAX_CHANNELS)] = 0
    level_channels: LevelChannels | None = None

    @classmethod
    def of(cls, source: object) -> Architecture:
        """The architecture of a network, or of settings: anything that has these fields as attributes."""
        return cls(**{name: getattr(source, name) for name in cls.model_fields})

    def widths(self, level: int) -> Widths:
        """The channels of a level (from 0)."""
        return widths_at(level, self.channels, self.level_channels)

    def kinds(self, level: int) -> dict[str, TensorKind]:
        """The tensors of a level (from 0) by name; nothing is allocated for it."""
        with torch.device("meta"):
            own = self.network(level + 1).levels[-1].state_dict()
        return {name: TensorKind.of(tensor) for name, tensor in own.items()}

    def network(self, levels: int, checkpointing: bool = False) -> OctNetFusion:
        """A new network, with random weights."""
        return OctNetFusion(levels=levels, checkpointing=checkpointing, **self.model_dump())


class TrainingData(Strict):
    """What was trained on: enough to refuse data whose values mean something else.

    Attributes:
        name: name of the data set.
        checksum: SHA-256 of its `dataset.json`.
        variant: name of the inputs.
        n_train, n_val: samples.
        extent: edge length of the cube in metres.
        truncation_voxels: tau, in voxels of any resolution.
    """

    name: str
    checksum: Sha256
    variant: str | None
    n_train: Int
    n_val: Int
    extent: Real
    truncation_voxels: Real

    def tau(self, resolution: int) -> float:
        """Truncation distance at a resolution, in metres."""
        return self.truncation_voxels * self.extent / resolution


class Header(Strict):
    """What a checkpoint says about itself.

    Attributes:
        schema_version: version of the format.
        level: number of the level, from 1.
        resolution: voxels along each axis.
        epoch, steps: when the weights were taken: epochs done, steps of the optimiser done.
        metrics: figures of the validation (`mad_mm`, or `mad` for occupancy; `iou`), and `train_loss`.
        settings: the settings of the run that the weights depend on.
        built_on: SHA-256 of the file of the level before.
        torch: version of PyTorch.
    """

    schema_version: Annotated[Literal[1], Field(alias="schema")] = CHECKPOINT_SCHEMA
    level: Annotated[Int, Field(ge=1, le=16)]
    resolution: Annotated[Int, Field(ge=1, le=2**16)]
    architecture: Architecture
    data: TrainingData
    epoch: Counted
    steps: Counted
    metrics: dict[str, Real]
    settings: dict[str, Any]
    built_on: Sha256 | None
    torch: str

    def to_dict(self) -> dict[str, Any]:
        """The header as JSON values."""
        return self.model_dump(mode="json", by_alias=True)


def parse_header(path: Path, fields: Mapping[str, Any]) -> Header:
    """A checkpoint's header.

    Raises:
        OcnfError: another schema version (code `schema`), or a field that is wrong.
    """
    if fields.get("schema") != CHECKPOINT_SCHEMA:
        raise OcnfError("the checkpoint has another schema version", code="schema", where=path,
                        field="schema", found=fields.get("schema"), expected=CHECKPOINT_SCHEMA,
                        fix="read it with the version of ocnf that wrote it, or train again")
    return validate(Header, fields, path)
