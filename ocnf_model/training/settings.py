"""Every part of a training run as a setting; the defaults are the paper's schedule.

>>> settings = TrainSettings()
>>> settings.stage(0).epochs, settings.stage(0).batch_size, settings.stage(2).accumulate
(50, 4, 4)
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.strict_yaml import read_yaml
from ocnf_data.files.validation import Int, NotEmpty, Positive, Real, Strict, refused, validate
from ocnf_data.loading.arguments import OnError
from ocnf_data.loading.augment import Augment
from ocnf_model.devices import Precision
from ocnf_model.header import MAX_CHANNELS, Channels, LevelChannels
from ocnf_model.network import Carry, Join, Normaliser, Output
from ocnf_model.training.choice import BestBy
from ocnf_model.training.schedule import Stage


class Loss(StrEnum):
    """How far a TSDF is from the truth; an occupancy has the binary cross entropy."""

    L1 = "l1"
    """The mean absolute difference in units of tau, not clipped (the paper)."""
    TRUNCATED_L1 = "truncated_l1"
    """The same, but beyond the truncation distance every prediction on the right side is right."""


class MixturePart(Strict):
    """One of several data sets that are trained on together."""

    data: str | None = None
    """A data set or a manifest; None for the one that is validated with."""
    meshes: str | None = None
    """The folder that a manifest's mesh paths are relative to; None for the command line's."""
    variant: str | None = None
    """Name of the inputs in a data set; None for the only one that has the encoding."""
    weight: Annotated[Real, Field(gt=0, le=1e6)] = 1.0
    """How often samples are drawn from it, relative to the other parts."""


class TrainSettings(Strict):
    """A training run. None means: what the data set says."""

    levels: Positive = 3
    """Resolutions that are reconstructed one after the other, coarse to fine."""
    resolutions: tuple[Annotated[Int, Field(ge=32, multiple_of=32)], ...] | None = None
    """Voxels along each axis, level by level, each twice the one before, in multiples of 32 (a level pools
    twice); None for the data set's, coarse to fine."""
    encoding: Encoding = Encoding.HISTOGRAM
    """Encoding of the inputs; the data set has to hold it."""
    variant: str | None = None
    """Name of the inputs in the manifest; None for the only one that has the encoding."""
    mixture: Annotated[tuple[MixturePart, ...], NotEmpty] | None = None
    """Data sets, variants of one, and manifests to train on, each sample from one of them by chance; None for
    the data set alone. Needs `samples_per_epoch`."""
    samples_per_epoch: Positive | None = None
    """How many samples make an epoch; None for all of the data set's, or what the manifest says."""
    categories: tuple[str, ...] | None = None
    """Train and validate on these categories only; None for all of them."""
    train_split: str = "train"
    """The split that the weights are fitted to."""
    val_split: str = "val"
    """The split that chooses the best epoch of each level."""
    join: Join = Join.CONCAT
    """How the decoder takes in the encoder's features."""
    carry: Carry = Carry.FEATURES
    """What a level hands to the next one."""
    output: Output | None = None
    """What is reconstructed; None for the data set's target."""
    channels: tuple[Channels, Channels, Channels] = (16, 32, 64)
    """Features at the level's resolution, at half and at a quarter of it."""
    level_channels: LevelChannels | None = None
    """Those of the first few levels, one after the other, where they differ: the first level costs the least,
    and the later ones rely on it. None for `channels` everywhere (the paper)."""
    band: Annotated[Real, Field(gt=0)] = 1.0
    """How far from the reconstructed surface the next level's cells are split, in its voxels."""
    context: Annotated[Int, Field(ge=0, le=MAX_CHANNELS)] = 0
    """Width of the first level's dense encoder-decoder that sees the whole volume, a multiple of 16;
    0 for none (the paper)."""
    residual: bool = False
    """Convolutions that keep the number of channels add their result to their input; the paper's do not."""
    normalise: Normaliser = Normaliser.NONE
    """What comes between a convolution and its ReLU."""
    blend: bool = False
    """Each level blends its TSDF with that of plain fusion, with a weight of its own for every voxel; the
    paper's does not."""
    finer: Annotated[Int, Field(ge=0, le=16)] = 0
    """How many levels, from the first on, also read the encoding of the next resolution, as the mean of eight
    voxels, or guess it where the data has none; 0 for none (the paper)."""
    blend_from: Annotated[Real, Field(gt=0, lt=1)] = 0.05
    """Share of plain fusion that a new blend begins with: little for few views, which leave much unseen, most
    for the many frames of a scan. A run to start from that has a blend keeps its own, and this is refused."""
    blend_learns: bool = True
    """Whether training changes the share. If not, it stays what it begins with, by `blend_from` or in the run
    to start from, and the network learns to be right together with that much of plain fusion."""
    extra_channels: Annotated[Int, Field(ge=0, le=MAX_CHANNELS)] = 0
    """Channels of the inputs behind the encoding's; only completion has some."""
    stages: Annotated[tuple[Stage, ...], NotEmpty] = (
        Stage(epochs=50, batch_size=4, accumulate=1), Stage(), Stage())
    """Settings for each level; the last ones hold for all levels that follow."""
    start: str | None = None
    """A run, or `pretrained`, whose weights the levels begin with; None, and for levels that it lacks: random
    ones for the first, those of the level before for later ones. What the settings leave out of the
    architecture is as it is there; `blend`, `context`, `finer` and more channels may be new, batch
    normalisation may go."""
    seed: Annotated[Int, Field(ge=0)] = 0
    """The seed of the first weights, the order of the samples and the augmentation."""
    augment: Augment = Augment.NONE
    """Symmetries of the cube that training samples are shown in."""
    shuffle_buffer: Positive = 1024
    """Samples in the window that is shuffled; shards are shuffled whatever it is."""
    loss: Loss = Loss.L1
    """What a TSDF is trained by."""
    wrong_sign: Annotated[Real, Field(ge=1, le=1e3)] = 1.0
    """Weight in that loss of a voxel on the wrong side of the surface, where any other has 1; 1 in the
    paper."""
    unseen: Annotated[Real, Field(ge=0, le=1)] = 1.0
    """Weight in that loss of a voxel that no input view has measured, where any other has 1: what is there
    can only be imagined, and of scans nobody looks at it; 1 in the paper."""
    average: Annotated[Real, Field(ge=0, lt=1)] = 0.0
    """Share of the past that a step keeps in the running average of the weights, which is what is validated
    and kept: 0.998 averages over some 500 steps. 0 for the weights as they are (the paper)."""
    precision: Precision = Precision.FLOAT32
    """What the convolutions compute in."""
    on_error: OnError = OnError.RAISE
    """What becomes of a damaged sample of a data set. (Bad meshes of a manifest give place to others, also in
    a mixture.)"""
    checkpointing: bool = False
    """Keep fewer activations for the backward pass, and compute them again."""
    workers: Annotated[Int, Field(ge=0)] = 1
    """Processes that read and decode, for each training process; 0 reads in the training process."""
    best_by: BestBy = BestBy.MAD_AND_F_SCORE
    """Which epoch's weights are a level's best checkpoint, and what the next level is trained on."""
    save_every: Positive = 50
    """Steps of the optimiser between two saved states, apart from those at the ends of epochs and where a
    quarter of an hour has gone by since the last."""

    @model_validator(mode="after")
    def _context_sees_everything(self) -> TrainSettings:
        if self.context and self.stage(0).crop is not None:
            raise refused("the first level's context needs the whole grid", at="stages[0].crop",
                          found=self.stage(0).crop, expected="null, or context: 0")
        return self

    @model_validator(mode="after")
    def _as_many_levels(self) -> TrainSettings:
        if self.finer > self.levels:
            raise refused("there are not as many levels", at="finer", found=self.finer,
                          expected=f"0 to {self.levels}")
        return self

    @model_validator(mode="after")
    def _boxes_have_a_size(self) -> TrainSettings:
        for level, stage in enumerate(self.stages):
            if stage.crops > 1 and stage.crop is None:
                raise refused("the whole grid is one box", at=f"stages[{level}].crops", found=stage.crops,
                              expected="1, or the side of a box as crop")
        return self

    @model_validator(mode="after")
    def _something_to_freeze(self) -> TrainSettings:
        for level, stage in enumerate(self.stages):
            if stage.freeze_after is not None and self.normalise is Normaliser.NONE:
                raise refused("there are no statistics to keep", at=f"stages[{level}].freeze_after",
                              found=stage.freeze_after, expected="null, or normalise: batch")
        return self

    @model_validator(mode="after")
    def _tells_what_is_seen(self) -> TrainSettings:
        if self.unseen != 1 and self.encoding is Encoding.OCCUPANCY:
            raise refused("this encoding does not tell what was measured", at="unseen", found=self.unseen,
                          expected="1, or another encoding")
        return self

    @field_validator("resolutions")
    @classmethod
    def _doubling(cls, resolutions: tuple[int, ...] | None) -> tuple[int, ...] | None:
        for fine, coarse in zip((resolutions or ())[1:], resolutions or (), strict=False):
            if fine != 2 * coarse:
                raise refused("not coarse to fine", expected="each twice the one before")
        return resolutions

    def stage(self, level: int) -> Stage:
        """How a level (from 0) is trained."""
        return self.stages[min(level, len(self.stages) - 1)]

    def up_to(self, level: int, manifest: Mapping[str, Any]) -> list[int]:
        """The resolutions that a level (from 0) reads: its own, those before, and perhaps the next."""
        read = self._grids(manifest)[:level + 1]
        if level < self.finer and 2 * read[-1] in manifest["resolutions"]:
            read.append(2 * read[-1])
        return read

    def own(self, level: int, manifest: Mapping[str, Any]) -> list[int]:
        """The resolution of a level (from 0), in a list: that of the ground truth."""
        return self._grids(manifest)[level:level + 1]

    def _grids(self, manifest: Mapping[str, Any]) -> list[int]:
        return list(self.resolutions or sorted(manifest["resolutions"])[: self.levels])

    def resolved(self, manifest: Mapping[str, Any], variant: str | None, where: str) -> TrainSettings:
        """These settings, with what the data set says filled in.

        Args:
            manifest: manifest of the data set.
            variant: name of the input variant that the loader chose.
            where: the data set, for messages.

        Raises:
            OcnfError: the data set has too few resolutions, or not the output's ground truth.
        """
        there = sorted(manifest["resolutions"])
        resolutions = self.resolutions or tuple(there[: self.levels])
        if len(resolutions) != self.levels:
            raise OcnfError("the levels do not fit the resolutions", where=where, field="levels",
                            found=self.levels, expected=f"{len(resolutions)}, for {resolutions}",
                            fix=f"pass --levels {len(resolutions)}")
        for level, resolution in enumerate(resolutions):
            crop = self.stage(level).crop
            if crop is not None and crop > resolution:
                raise OcnfError("the crop is larger than the grid", code="manifest", where=where,
                                field=f"stages[{min(level, len(self.stages) - 1)}].crop", found=crop,
                                expected=f"at most {resolution}, or null for the whole grid")
        target = Output(manifest["target"])
        output = self.output or target
        if output is Output.TSDF and target is Output.OCCUPANCY:
            raise OcnfError("the data set holds no TSDF to learn", where=where, field="output", found=output,
                            expected=target)
        filled = {**self.to_dict(), "resolutions": list(resolutions), "output": str(output),
                  "variant": variant or self.variant}
        return read_settings(filled, where)

    def to_dict(self) -> dict[str, Any]:
        """JSON values of all fields. Those of mixtures are left out where there is none, as in older runs."""
        fields = self.model_dump(mode="json")
        return {name: value for name, value in fields.items()
                if value is not None or name not in ("mixture", "samples_per_epoch")}

    def decisive(self) -> dict[str, Any]:
        """Values of the fields that the weights depend on. Where a mixture's parts lie is none of them."""
        fields = {name: value for name, value in self.to_dict().items() if name not in FREE_TO_CHANGE}
        if self.mixture is not None:
            fields["mixture"] = [{"variant": part.variant, "weight": part.weight} for part in self.mixture]
        return fields


FREE_TO_CHANGE = frozenset({"checkpointing", "workers", "save_every"})
"""Fields that another start of the same run may set otherwise: the weights do not depend on them."""


def setting_difference(ours: TrainSettings, theirs: TrainSettings) -> tuple[str, Any, Any] | None:
    """The first field in which two runs differ: its name, our value, their value."""
    return _difference(ours.decisive(), theirs.decisive(), "")


def _difference(ours: Any, theirs: Any, at: str) -> tuple[str, Any, Any] | None:
    if ours == theirs:
        return None
    if isinstance(ours, dict):
        found = (_difference(ours.get(name), theirs.get(name), f"{at}.{name}" if at else name)
                 for name in {**ours, **theirs})
    elif isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs):
        found = (_difference(a, b, f"{at}[{i}]") for i, (a, b) in enumerate(zip(ours, theirs, strict=True)))
    else:
        return at, ours, theirs
    return next(difference for difference in found if difference)


def read_settings(fields: object, where: object) -> TrainSettings:
    """Settings from JSON or YAML values, a mapping.

    Raises:
        OcnfError: a field that is unknown or impossible, by name.
    """
    return validate(TrainSettings, fields, where)


def load_settings(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The fields in a YAML or JSON file, for `read_settings`.

    Raises:
        OcnfError: it cannot be read, or is not a mapping.
    """
    fields = read_yaml(path)
    if not isinstance(fields, dict):
        raise OcnfError("not a mapping of fields to values", where=path, found=type(fields).__name__)
    return fields
