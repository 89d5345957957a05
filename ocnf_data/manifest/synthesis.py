"""The manifest's section on training data without end: what is drawn for every sample.

    synthesis:
      samples_per_epoch: 2000
      rotate: {upright: 1, any: 1}      # a name, or names with weights
      directions: {random: 3, rig: 1}
      views: [1, 6]
      sigma: [0.0, 0.03]

`generate` does not look at it: a data set on disk has the views, noise and poses that `inputs` names.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from ocnf_data.errors import OcnfError
from ocnf_data.files.validation import Int, Real, Strict, refused
from ocnf_data.views.noise import NoiseModel

Name = TypeVar("Name", bound=StrEnum)


class Rotate(StrEnum):
    """How a mesh is turned before it is scaled into the cube."""

    NONE = "none"
    """The mesh stays as its file has it."""
    UPRIGHT = "upright"
    """The mesh is turned about its vertical axis, by any angle."""
    ANY = "any"
    """The mesh is turned by any rotation, all of them equally likely."""


class Directions(StrEnum):
    """Where the k cameras of an input stand."""

    RIG = "rig"
    """The rig's own subset of k views, as in the paper: for 4 of 80 views 0, 26, 52 and 79."""
    RANDOM = "random"
    """Any k views of the rig."""
    SPHERE = "sphere"
    """Anywhere on the sphere of the rig's cameras, evenly."""


class SceneCameras(StrEnum):
    """The cameras of an input that sees a procedural scene."""

    PATH = "path"
    """On a hand-held path (`views.trajectories`): through a room, turning around or watching a part of it;
    around a table."""
    SINGLE = "single"
    """Each by itself: somewhere in a room, or above a table, looking at any point of what the cube holds."""


def _weights(value: Any) -> Any:
    """One name stands for itself alone; all weights 0 would leave nothing to draw."""
    if isinstance(value, str):
        return {value: 1.0}
    if isinstance(value, Mapping):
        if not value:
            raise refused("the list is empty", expected="at least one")
        return {name: float(weight) if isinstance(weight, int) and not isinstance(weight, bool) else weight
                for name, weight in value.items()}
    raise refused("not a name, nor names with weights", expected="such as any, or {upright: 1, any: 2}")


DrawWeight = Annotated[Real, Field(gt=0, le=1e6)]
Weights = Annotated[dict[Name, DrawWeight], BeforeValidator(_weights)]


def _range(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise refused("the range is the wrong way round", expected="the lower end first")
    return value


Range = AfterValidator(_range)


class Synthesis(Strict):
    """What `SynthesisDataset` draws for each sample from (seed, epoch, number) alone.

    Procedural shapes and scenes are new ones in every epoch, without end; the source's counts do not limit
    them. Of mesh files each of the split is as likely, as often as its source is drawn (see `mixture`
    sources).
    """

    samples_per_epoch: Annotated[Int, Field(ge=1, le=100_000_000)] = 1000
    """How many samples make an epoch; all ranks share them."""
    rotate: Weights[Rotate] = Field(default={Rotate.NONE: 1.0}, validate_default=False)
    """The rotation of the mesh: a name, or names with weights."""
    up: Literal["x", "y", "z"] = "z"
    """The axis of mesh files that points up, for `upright`. That of procedural shapes and scenes is z."""
    scale: Annotated[tuple[Annotated[Real, Field(gt=0, le=1)], Annotated[Real, Field(gt=0, le=1)]],
                     Range] = (1.0, 1.0)
    """Range of the factor by which a mesh is made smaller than the normalised one."""
    directions: Weights[Directions] = Field(default={Directions.RIG: 1.0}, validate_default=False)
    """The cameras of the inputs that see a mesh or a shape: a name, or names with weights."""
    cameras: Weights[SceneCameras] = Field(default={SceneCameras.PATH: 1.0, SceneCameras.SINGLE: 1.0},
                                           validate_default=False)
    """The cameras of the inputs that see a scene: a name, or names with weights."""
    zoom: Annotated[tuple[Annotated[Real, Field(ge=1, le=20)], Annotated[Real, Field(ge=1, le=20)]],
                    Range] = (1.0, 1.0)
    """Range of the factor by which a scene is magnified, its logarithm evenly drawn. Above 1 the cube holds a
    part of the scene, about one of its things or walls, as tiles and boxes do in `fuse`."""
    views: Annotated[tuple[Annotated[Int, Field(ge=1)], Annotated[Int, Field(ge=1)]], Range] = (1, 6)
    """Least and largest number of input views, each number as likely."""
    sigma: Annotated[tuple[Annotated[Real, Field(ge=0, le=1)], Annotated[Real, Field(ge=0, le=1)]],
                     Range] = (0.0, 0.03)
    """Range of the standard deviation of the noise of `park`, as a fraction of the depth."""
    noise: Weights[NoiseModel] = Field(default={NoiseModel.PARK: 1.0}, validate_default=False)
    """The noise model: a name, or names with weights."""
    strength: Annotated[tuple[Annotated[Real, Field(ge=0, le=10)], Annotated[Real, Field(ge=0, le=10)]],
                        Range] = (1.0, 1.0)
    """Range of the strength of `kinect`: 0 is no noise at all, 1 that of the sensor."""
    metres: Annotated[Real, Field(gt=0, le=1000)] = 1.0
    """How many real metres a metre of the grid stands for, in the noise of `kinect`. Scenes have real sizes,
    which are taken instead."""
    misaligned: Annotated[tuple[Annotated[Real, Field(ge=0, le=32)], Annotated[Real, Field(ge=0, le=32)]],
                          Range] = (0.0, 0.0)
    """Range of the error of the poses that the views are fused by: the standard deviation by which it moves
    what a camera sees, in voxels of the finest resolution."""
    repeat: Annotated[Int, Field(ge=1, le=1000)] = 1
    """Number of epochs in which sample i keeps its mesh, rotation and scale, while its views, noise and
    symmetry are drawn again each time. Its ground truth, most of the work, is then made once and kept in a
    cache."""

    def refuse_idle(self, where: object) -> None:
        """Refuse a field that is not its default and would not be looked at beside the others.

        Only in what a user writes: a data set that was made with such a manifest before stays readable.

        Args:
            where: the manifest, for messages.

        Raises:
            OcnfError: code `manifest`, with the field.
        """
        defaults = Synthesis()
        for fields, used, reason, remedy in (
            (("strength", "metres"), NoiseModel.KINECT in self.noise, "there is no noise of kinect",
             "kinect among noise"),
            (("sigma",), NoiseModel.PARK in self.noise, "there is no noise of park", "park among noise"),
            (("up",), Rotate.UPRIGHT in self.rotate, "nothing is turned about it", "upright among rotate"),
        ):
            for field in fields:
                found, default = getattr(self, field), getattr(defaults, field)
                if not used and found != default:
                    raise OcnfError(f"it would have no effect: {reason}", code="manifest", where=where,
                                    field=f"synthesis.{field}", found=_plain(found),
                                    expected=f"{_plain(default)}, or {remedy}")


def _plain(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value
