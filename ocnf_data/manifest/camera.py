"""The manifest's sections on how meshes are placed and which virtual cameras look at them."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, field_validator, model_validator

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.files.validation import Int, Real, Strict, refused
from ocnf_data.views.rigs import intrinsics, rig_from_name
from ocnf_data.views.trajectories import path_from_name


class Normalise(Strict):
    """How a mesh is placed: its bounding box centred, its longest edge `(1 - padding) * extent`."""

    extent: Annotated[Real, Field(gt=0, le=1e3)] = 3.0
    """Side of the grid's cube in metres."""
    padding: Annotated[Real, Field(ge=0, lt=1)] = 0.05
    """Share of the extent that stays empty, half of it at either end of the longest side."""

    @property
    def radius(self) -> float:
        """Half the diagonal of the largest bounding box, metres: no vertex is farther from the origin."""
        return (1 - self.padding) * self.extent * float(np.sqrt(3)) / 2

    @property
    def near(self) -> float:
        """What is no farther from a camera is not drawn, metres: 1 mm, less for a cube under a metre."""
        return 1e-3 * min(1.0, self.extent)


class Camera(Strict):
    """The virtual cameras: `rig` names them, the rest is one pinhole for all of them (pixels).

    Rigs of directions look at the origin from `distance`. `around<n>` and `inside<n>` are hand-held paths,
    another for each item: around the origin at about `distance`, or within the mesh's box
    (`views.trajectories`).
    """

    rig: str = "published80"
    """`published80` (the 80 directions of the paper's published code), `icosphereN` (20 * 4^N directions, N
    up to 5), `fibonacciN` (N directions, up to 20480), or a hand-held path of N views, up to 2000, another
    for each item: `aroundN`, or `insideN` the mesh's box."""
    width: Annotated[Int, Field(ge=1, le=8192)] = 640
    """Columns of the image, pixels."""
    height: Annotated[Int, Field(ge=1, le=8192)] = 480
    """Rows of the image, pixels."""
    fx: Annotated[Real, Field(gt=0)] = 351.0
    """Focal length along x, pixels."""
    fy: Annotated[Real, Field(gt=0)] = 351.0
    """Focal length along y, pixels."""
    cx: Real = 320.0
    """Column of the principal point, pixels, within the image; the centre of the first pixel is 0."""
    cy: Real = 240.0
    """Row of the principal point, pixels, within the image; the centre of the first pixel is 0."""
    distance: Annotated[Real, Field(gt=0)] = 3.0
    """Distance from the origin to each camera, metres; more than half the diagonal of the largest bounding
    box, which is 2.468 m for the default extent and padding."""

    @field_validator("rig")
    @classmethod
    def _known_rig(cls, name: str) -> str:
        try:
            if path_from_name(name) is None:
                rig_from_name(name)
        except OcnfError as error:
            raise refused(error.what, expected=error.expected) from error
        return name

    @model_validator(mode="after")
    def _principal_point_inside(self) -> Camera:
        """Outside, it is that of an image of another size, and the cameras look past the mesh."""
        for field, side in (("cx", self.width), ("cy", self.height)):
            if not -0.5 <= getattr(self, field) <= side - 0.5:
                raise refused("the principal point lies outside of the image", at=f".{field}",
                              found=getattr(self, field), expected=f"-0.5 to {side - 0.5}")
        return self

    @property
    def n_views(self) -> int:
        """Number of views in the rig; the ground truth is fused from all of them."""
        return self.path[1] if self.path else len(rig_from_name(self.rig))

    @property
    def path(self) -> tuple[str, int] | None:
        """(`around` or `inside`, number of views) of a hand-held path; None for a rig of directions."""
        return path_from_name(self.rig)

    @property
    def size(self) -> tuple[int, int]:
        """Image size (H, W)."""
        return self.height, self.width

    @property
    def K(self) -> F64:
        """Intrinsics (3, 3), pixels."""
        return intrinsics(self.fx, self.fy, self.cx, self.cy)
