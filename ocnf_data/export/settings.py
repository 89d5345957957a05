"""What an export writes: the format and its options, checked once and recorded beside the files."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from typing import Any

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError

MAX_POINTS = 100_000_000


class ExportFormat(StrEnum):
    """The formats that a data set can be exported in."""

    DENSE = "dense"
    """`.npz` with the ground truth and the inputs as volumes (C, D, H, W)."""
    POINTS = "points"
    """Surface points, occupancies and signed distances as Occupancy Networks and DeepSDF read them."""
    MESH = "mesh"
    """PLY: the surface of the ground truth, and that of every TSDF input."""
    VDB = "vdb"
    """OpenVDB: the ground truth and every TSDF input as level sets in one file."""


class Coordinates(StrEnum):
    """The frame of exported coordinates; axes are x, y, z, and the origin is the cube's centre in each."""

    METRES = "metres"
    """The cube of the data set, `normalise.extent` metres (3 m unless the manifest says otherwise) a side."""
    UNIT_CUBE = "unit-cube"
    """That cube shrunk to [-0.5, 0.5], as Occupancy Networks have it."""
    UNIT_SPHERE = "unit-sphere"
    """Shrunk, sample by sample, until the surface fits a sphere of radius 1 / 1.03, as DeepSDF has it."""


@dataclass(frozen=True)
class ExportSettings:
    """What is written of each sample.

    Attributes:
        format: see `ExportFormat`.
        resolution: voxels along a side, one of the data set's; None is the largest.
        variant: the input variant to write; None is all. Points take no inputs.
        encoding: the input encoding to write; None is all. Meshes and VDB grids take `tsdf` only.
        points: points of each kind and sample: on the surface, with occupancies, with distances.
        coordinates: None is what the readers of each file expect: the unit cube for `pointcloud.npz` and
            `points.npz`, the unit sphere for DeepSDF, metres for meshes and grids. Volumes have none.
        stored: write volumes in the dtype in which they are stored (uint8 shares of 255, float16) instead
            of float32.

    Raises:
        OcnfError: an option that the format does not have, or a value out of range.
    """

    format: ExportFormat
    resolution: int | None = None
    variant: str | None = None
    encoding: Encoding | None = None
    points: int = 100_000
    coordinates: Coordinates | None = None
    stored: bool = False

    def __post_init__(self) -> None:
        for name, kind in (("format", ExportFormat), ("encoding", Encoding), ("coordinates", Coordinates)):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _one_of(kind, name, value))
        if not 1 <= self.points <= MAX_POINTS:
            raise OcnfError("not a number of points", where="export", field="points", found=self.points,
                            expected=f"1 to {MAX_POINTS}")
        of_surfaces = self.format in (ExportFormat.MESH, ExportFormat.VDB)
        if of_surfaces and self.encoding not in (None, Encoding.TSDF):
            raise OcnfError(f"{self.format} holds surfaces, which only a TSDF has", where="export",
                            field="encoding", found=self.encoding, expected="tsdf",
                            fix="export the other encodings as dense")
        for field in fields(self):
            if getattr(self, field.name) != field.default and self.format in _UNUSED.get(field.name, ()):
                raise OcnfError(f"the format {self.format} has no such option", where="export",
                                field=field.name, found=getattr(self, field.name), fix="leave it out")

    def to_dict(self) -> dict[str, Any]:
        """The settings in JSON's types: what a later run into the same folder has to agree with."""
        return {name: str(value) if isinstance(value, StrEnum) else value
                for name, value in asdict(self).items()}


_UNUSED: dict[str, tuple[ExportFormat, ...]] = {
    "variant": (ExportFormat.POINTS,),
    "encoding": (ExportFormat.POINTS,),
    "points": (ExportFormat.DENSE, ExportFormat.MESH, ExportFormat.VDB),
    "coordinates": (ExportFormat.DENSE,),
    "stored": (ExportFormat.POINTS, ExportFormat.MESH, ExportFormat.VDB),
}


def _one_of(kind: type[StrEnum], name: str, value: str) -> StrEnum:
    try:
        return kind(value)
    except ValueError:
        raise OcnfError(f"not a value of {name}", where="export", field=name, found=value,
                        expected=", ".join(kind)) from None
