"""Scans as a source: posed depth frames, of which every item is one configuration of input frames."""

from __future__ import annotations

import os
import posixpath
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.files.validation import Int, Real, Strict, refused
from ocnf_data.manifest.entries import SPLITS, Entry, given
from ocnf_data.meshes.listing import is_hidden
from ocnf_data.sequences import Box
from ocnf_data.sequences.configurations import Deal, split_in_time
from ocnf_data.sequences.frames import FrameSequence
from ocnf_data.views.scans import SCAN_FORMATS, Axes, Direction
from ocnf_data.views.scans.listing import Said
from ocnf_data.views.scans.selection import choose


class Configurations(Strict):
    """Configurations of each scan in each split. The frames are cut in time in the same proportions."""

    train: Annotated[Int, Field(ge=0)] = 0
    val: Annotated[Int, Field(ge=0)] = 0
    test: Annotated[Int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _some(self) -> Configurations:
        if not any(self.by_split.values()):
            raise refused("the data set would be empty", expected="a count above 0")
        return self

    @property
    def by_split(self) -> dict[str, int]:
        """The counts, in the order of time: train, val, test."""
        return {split: getattr(self, split) for split in SPLITS}


class ScanReading(Strict):
    """What holds in place of the scans' own format; all scans of the source share it."""

    format: str | None = None
    """Name of the format, as `ocnf-model fuse --format` takes it; None: the one that the names fit."""
    depth_scale: Annotated[Real, Field(gt=0)] | None = None
    """Units of the stored depth in a metre: 1000 is millimetres."""
    intrinsics: tuple[Real, Real, Real, Real] | None = None
    """fx, fy, cx, cy of the depth maps, pixels."""
    poses: Direction | None = None
    """What the pose matrices in the files do with a point."""
    pose_scale: Annotated[Real, Field(gt=0)] = 1.0
    """Length in metres of a unit of the poses' translations."""
    crop: tuple[Annotated[Int, Field(ge=0)], Annotated[Int, Field(ge=0)], Annotated[Int, Field(ge=0)],
                Annotated[Int, Field(ge=0)]] = (0, 0, 0, 0)
    """Pixels along left, top, right and bottom of the depth maps that are not used."""

    axes: Axes | None = None
    """Axes of the cameras in the pose matrices."""

    @model_serializer(mode="wrap")
    def _as_before(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Where no axes are given it says what it always said, so that data sets begun before go on."""
        fields: dict[str, Any] = handler(self)
        if self.axes is None:
            fields.pop("axes", None)
        return fields

    @field_validator("format")
    @classmethod
    def _known(cls, name: str | None) -> str | None:
        if name is not None and name not in SCAN_FORMATS:
            raise refused("no such format of scans", expected=f"one of {', '.join(SCAN_FORMATS)}")
        return name

    @property
    def said(self) -> Said:
        """The same, as readers take it."""
        return Said(self.depth_scale, self.intrinsics, self.poses, self.pose_scale, self.crop, self.axes)


def _region(value: Any) -> Any:
    """`object`, or a box."""
    if value == "object":
        return value
    numbers = isinstance(value, list | tuple) and len(value) == 6 and all(
        isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e6 for x in value)
    if not numbers or any(value[i] >= value[i + 3] for i in range(3)):
        raise refused("not a region", expected="object, or x0, y0, z0, x1, y1, z1 in metres with x0 < x1, "
                                               "y0 < y1, z0 < z1")
    return tuple(map(float, value))


ScanRegion = Annotated[Literal["object"] | Box, BeforeValidator(_region)]


class ScanEntry(Strict):
    """One scan; a bare string is its path."""

    path: Annotated[str, Field(min_length=1)]
    """Folder of the scan, relative to the root."""
    region: ScanRegion | None = None
    """The region of this scan; None: that of the source."""
    configurations: Configurations | None = None
    """The configurations of this scan; None: those of the source."""


def _scans(value: Any) -> Any:
    if value == "all":
        return value
    if not isinstance(value, list | tuple) or not value:
        raise refused("not a list of scans", expected="paths of folders, or all")
    return tuple({"path": one} if isinstance(one, str) else one for one in value)


class SequenceSource(Strict):
    """Scans: folders of posed depth frames, in any format that `ocnf-model fuse` reads.

    The frames of a scan together give the ground truth of all its samples. A sample is one configuration: a
    random subset of the frames, whose first k are what an input of k views sees. The frames of a scan are cut
    in time into those of train, val and test, so no frame is in inputs of two splits.
    """

    kind: Literal["sequence"]
    root: str | None = None
    """The folder that the paths are relative to, itself relative to the manifest's folder; `--root` (or
    `--meshes`) on the command line takes precedence."""
    scans: Annotated[Literal["all"] | tuple[ScanEntry, ...], BeforeValidator(_scans)]
    """Folders of scans: a list of paths, or `all` that lie directly below the root."""
    configurations: Configurations
    disjoint: bool = True
    """No two configurations of a scan share a frame; a scan with too few frames is refused. `false`: when all
    frames of a split are used, they are shuffled and dealt out again."""
    frames: Annotated[str, Field(min_length=1)] | Annotated[Int, Field(ge=1)] | None = None
    """Which frames of a scan are used at all, for reference and inputs: a number, spread evenly, or a range
    START:STOP:STEP; None: all."""
    region: ScanRegion = "object"
    """What is fused: a box x0, y0, z0, x1, y1, z1 in metres in the scan's coordinates, or `object`: the cube
    that the scan's format names, else the largest connected surface."""
    stretches: Annotated[Int, Field(ge=1, le=1000)] = 1
    """Number of equal stretches of time, each of which is cut into frames of train, val and test."""
    gap: Annotated[Int, Field(ge=0, le=100_000)] = 0
    """Number of frames that are left out between those of different splits."""
    reading: ScanReading = ScanReading()

    @field_validator("frames")
    @classmethod
    def _a_choice(cls, frames: str | int | None) -> str | int | None:
        try:
            choose(10**6, frames)
        except OcnfError as error:
            raise refused(error.what, expected=error.expected) from error
        return frames

    def entries(self, root: Path | None, seed: int = 0, views: int = 1) -> list[Entry]:
        """An entry for each configuration, by scan, split and number.

        Args:
            root: the folder that the paths are relative to.
            seed: the manifest's.
            views: frames in a configuration.

        Raises:
            OcnfError: no scan, one that cannot be listed, or one with too few frames for its configurations.
        """
        base = given(root)
        found = []
        for scan in self.listed(base):
            n_frames = len(self.open(base, scan.path))
            category = PurePosixPath(scan.path).name or base.name
            for split, count in (scan.configurations or self.configurations).by_split.items():
                if count:
                    deal = self.deal(n_frames, scan.path, split, views, seed)
                    deal.check(count, self.disjoint, base / scan.path, split)
                found += [Entry(split, category, scan.path, index=i) for i in range(count)]
        return found

    def listed(self, root: Path) -> list[ScanEntry]:
        """The scans, with normal paths.

        Raises:
            OcnfError: there are none, or one is listed twice.
        """
        if self.scans == "all":
            with storage_errors(root):
                names = sorted(path.name for path in root.iterdir()
                               if path.is_dir() and not is_hidden(path.name))
            scans = [ScanEntry(path=name) for name in names if _is_scan(root / name, self.reading.format)]
            if not scans:
                raise OcnfError("no scan found", code="empty", where=root, field="source.scans",
                                expected="folders with posed depth frames",
                                fix="give the folder that the scans' folders lie in as --root ROOT")
            return scans
        scans = [scan.model_copy(update={"path": posixpath.normpath(scan.path)}) for scan in self.scans]
        known: dict[str, str] = {}
        for scan in scans:
            place = os.path.realpath(root / scan.path)
            if place in known:
                raise OcnfError("a scan is listed twice", field="source.scans", found=scan.path,
                                expected=f"each once (it is also {known[place]})")
            known[place] = scan.path
        return scans

    def open(self, root: Path, path: str) -> FrameSequence:
        """The frames of a scan that are used."""
        return FrameSequence.open(root / path, self.reading.format, self.reading.said, self.frames)

    def deal(self, n_frames: int, path: str, split: str, views: int, seed: int) -> Deal:
        """The configurations of a split of a scan.

        Args:
            n_frames: number of frames used.
            path: path of the scan, as `listed` has it.
            split: `train`, `val` or `test`.
            views: frames in a configuration.
            seed: the manifest's.
        """
        counts = self._of(path).configurations or self.configurations
        frames = split_in_time(n_frames, counts.by_split, self.stretches, self.gap)
        return Deal(frames.get(split, ()), views, (seed, path, split))

    def region_of(self, path: str) -> Literal["object"] | Box:
        """The region of a scan."""
        return self._of(path).region or self.region

    def _of(self, path: str) -> ScanEntry:
        if self.scans != "all":
            for scan in self.scans:
                if posixpath.normpath(scan.path) == path:
                    return scan
        return ScanEntry(path=path)


def _is_scan(folder: Path, format: str | None) -> bool:
    formats = SCAN_FORMATS.values() if format is None else (SCAN_FORMATS[format],)
    return any(one.fits(folder) for one in formats)
