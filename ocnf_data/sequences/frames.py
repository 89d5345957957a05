"""The frames of a scan that a data set uses, and their checksum."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.views.scans import Scan, list_scan
from ocnf_data.views.scans.listing import Frame, Listing, Said, check_pinhole
from ocnf_data.views.scans.load import load, posed
from ocnf_data.views.scans.selection import choose


@dataclass(frozen=True)
class FrameSequence:
    """The frames of one scan that are used, in the order of time; no image has been decoded yet.

    Attributes:
        folder: the scan.
        listing: the frames, all of them with a finite pose, what their numbers mean, and notes on those that
            are left out.
        format: name of the scan's format.
        said: what the manifest says in place of the format's own definition.
    """

    folder: Path
    listing: Listing
    format: str
    said: Said

    @classmethod
    def open(cls, folder: str | os.PathLike[str], format: str | None = None, said: Said | None = None,
             frames: str | int | None = None) -> FrameSequence:
        """List a scan.

        Args:
            folder: a folder in any format that `ocnf_data.views.scans` reads.
            format: the format's name; None: the one that the folder's names fit.
            said: what holds in place of the format's definition.
            frames: which of the frames whose pose is known are used (see `choose`); None: all.

        Raises:
            OcnfError: there is no such scan, its format is not known, a file of poses cannot be read,
                intrinsics that hold are not a pinhole's, or no frame is left (`empty`).
        """
        said = said or Said()
        listing, name = list_scan(folder, format, said.intrinsics is not None)
        usable = posed(listing, folder)
        chosen = tuple(usable.frames[i] for i in choose(len(usable.frames), frames))
        used = replace(usable, frames=chosen)
        if said.intrinsics is None:
            for frame in chosen:
                if frame.K is not None:
                    check_pinhole(frame.K, f"{frame.where}: {frame.name}")
        return cls(Path(folder), used, name, said)

    def __len__(self) -> int:
        return len(self.listing.frames)

    @property
    def names(self) -> tuple[str, ...]:
        """The frames' names, in the order of time."""
        return tuple(frame.name for frame in self.listing.frames)

    def checksum(self) -> str:
        """SHA-256 over all that the depth in the scan's coordinates depends on.

        That is, for each frame, the bytes of its depth map, its pose and its intrinsics as numbers, and what
        the numbers mean. Colour, comments and where the scan lies are not in it.

        Raises:
            OcnfError: a depth map cannot be read.
        """
        listing, said = self.listing, self.said
        meaning = [listing.unit if said.depth_scale is None else 1 / said.depth_scale,
                   str(said.direction or listing.direction), str(said.axes or listing.axes), listing.cube,
                   said.intrinsics and [float(value) for value in said.intrinsics],
                   float(said.pose_scale), said.crop]
        return sha256_hex(canonical_json([meaning, *map(_frame_facts, listing.frames)]))

    def read(self, positions: Sequence[int] | None = None) -> Scan:
        """Decode frames.

        Args:
            positions: which, in this order, counted from 0 among the frames used; None: all.

        Raises:
            OcnfError: a depth map that is damaged or of another size, a pose that is not rigid, no
                intrinsics: with the file's name.
        """
        frames = self.listing.frames
        chosen = frames if positions is None else tuple(frames[i] for i in positions)
        return load(replace(self.listing, frames=chosen), self.folder, self.format, said=self.said)


def _frame_facts(frame: Frame) -> list[object]:
    """What is the frame's own. Intrinsics that are not finite are none: others have taken their place."""
    with storage_errors(frame.depth), frame.depth.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    K = None if frame.K is None or not np.isfinite(frame.K).all() else frame.K.tolist()
    return [frame.name, digest, frame.pose.tolist(), K]
