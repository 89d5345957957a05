"""The manifest's section on one kind of input: views, noise and encodings."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from ocnf_data.encodings import Encoding
from ocnf_data.files.validation import Int, NotEmpty, Real, Strict, refuse_repeats, refused

_IDENTIFIER = re.compile(r"[A-Za-z0-9_]+")


class Variant(Strict):
    """One kind of input: `views` of the rig, with noise, in one or more encodings at every resolution."""

    name: str
    """The first part of the names of its octrees; letters, digits and `_`, each name
    once, not `target`."""
    views: Annotated[Int, Field(ge=1)]
    """How many views of the rig it sees, at most all; of N views
    `linspace(0, N - 1, views)`, cut to integers."""
    sigma: Annotated[Real, Field(ge=0, le=1)] = 0.0
    """Standard deviation of the noise of `park`, as a fraction of the depth."""
    noise: Literal["park", "kinect"] = "park"
    """`park`: independent in each pixel (`views.noise`). `kinect`: a sensor's (`views.sensor`)."""
    strength: Annotated[Real, Field(ge=0, le=10)] = 1.0
    """Strength of the noise of `kinect`: 0 is none, 1 that of a Kinect."""
    metres: Annotated[Real, Field(gt=0, le=1000)] = 1.0
    """How many real metres a metre of the grid stands for, in the noise of `kinect`; of scenes
    and scans, which have real sizes, a metre of theirs."""
    encodings: Annotated[tuple[Encoding, ...], NotEmpty]
    """How the views are written into octrees, each encoding at most once."""

    @model_validator(mode="after")
    def _of_one_noise(self) -> Variant:
        if self.noise == "kinect" and self.sigma:
            raise refused("sigma belongs to the noise park", at=".sigma", found=self.sigma,
                          expected="none with kinect, which has strength")
        for field in ("strength", "metres"):
            if self.noise == "park" and getattr(self, field) != 1:
                raise refused(f"{field} belongs to the noise kinect", at=f".{field}",
                              found=getattr(self, field), expected="none with park, which has sigma")
        return self

    @model_serializer(mode="wrap")
    def _as_before(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A variant with Park's noise says what it always said, so that data sets begun before go on."""
        fields: dict[str, Any] = handler(self)
        if self.noise == "park":
            for name in ("noise", "strength", "metres"):
                del fields[name]
        return fields

    @field_validator("name")
    @classmethod
    def _plain_name(cls, name: str) -> str:
        if not _IDENTIFIER.fullmatch(name) or name == "target":
            raise refused("not a name for an input", expected="letters, digits and _; `target` is taken")
        return name

    @field_validator("encodings")
    @classmethod
    def _each_once(cls, encodings: tuple[Encoding, ...]) -> tuple[Encoding, ...]:
        refuse_repeats([str(encoding) for encoding in encodings])
        return encodings

    @property
    def noise_in_words(self) -> str:
        """For captions: `sigma 0.02`, or `kinect, strength 1`."""
        if self.noise == "park":
            return f"sigma {self.sigma:g}"
        return f"{self.noise}, strength {self.strength:g}"
