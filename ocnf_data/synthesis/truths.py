"""Ground truth that the epochs of a season share, in a folder: a cache, which changes nothing but the time.

    CACHE/<checksum>/season-000004/<SHA-256 of body and resolution>.oct      as `octree.codec` encodes it

Processes write without a word to one another: whole files by rename, and equal names have equal contents.
What cannot be read is made again, and what cannot be kept is made every time. A season's folder goes when the
one after the next begins, unless it was used meanwhile: then it is the season of another run.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.files.storage import Store
from ocnf_data.octree.codec import decode_raw, encode_raw
from ocnf_data.octree.stored import TARGET, RawOctree
from ocnf_data.synthesis.sample import Truths

_PREFIX = "season-"
_log = logging.getLogger(__name__)


class TruthCache:
    """Ground truths of the bodies of one source in a folder.

    Args:
        folder: folder of the cache; it need not exist.
        checksum: SHA-256 of the sources, their `checksum`.
    """

    def __init__(self, folder: Path, checksum: str) -> None:
        self._folder, self._checksum = folder / checksum[:16], checksum
        self._season = -1
        self._refused = False

    def find(self, season: int, body: list[int], resolutions: tuple[int, ...],
             make: Callable[[tuple[int, ...]], Truths]) -> Truths:
        """The ground truths of a body, by resolution: from the cache, or made and kept.

        Args:
            season: number of the season that the body belongs to.
            body: what it was drawn with beside the season: seed, number, attempt.
            resolutions: the resolutions that are wanted, voxels along each axis.
            make: makes them for these resolutions.
        """
        self._tidy(season)
        store = Store(self._place(season))
        names = {resolution: self._name(season, body, resolution) for resolution in resolutions}
        found = {resolution: octree for resolution, name in names.items()
                 if (octree := _read(store, name, resolution)) is not None}
        missing = tuple(resolution for resolution in resolutions if resolution not in found)
        if missing:
            made = make(missing)
            for resolution, octree in made.items():
                self._keep(store, names[resolution], encode_raw(octree))
            found |= made
        return found

    def _keep(self, store: Store, name: str, data: bytes) -> None:
        """Write a file, or say once that it cannot be: a sample must not depend on whether there is room."""
        try:
            store.put_bytes(name, data)
        except OcnfError as error:
            if not self._refused:
                _log.warning("ground truths are made again every time, as they cannot be kept: %s", error)
            self._refused = True

    def _place(self, season: int) -> Path:
        return self._folder / f"{_PREFIX}{season:06d}"

    def _name(self, season: int, body: list[int], resolution: int) -> str:
        return f"{sha256_hex(canonical_json([self._checksum, season, *body, resolution]))}.oct"

    def _tidy(self, season: int) -> None:
        """Remove the seasons that no worker of any run is in any more."""
        with contextlib.suppress(OSError):  # a folder that another process removes at the same moment
            os.utime(self._place(season))  # reading alone would leave no trace of its being in use
        if season == self._season:
            return
        self._season = season
        begun = _begun(self._place(season - 1))
        for folder in self._folder.glob(f"{_PREFIX}*"):
            number = folder.name.removeprefix(_PREFIX)
            if number.isdigit() and abs(int(number) - season) > 1 and _used(folder) < begun:
                shutil.rmtree(folder, ignore_errors=True)


def _begun(folder: Path) -> float:
    """When the first file of a season was written; -inf where there is none, and so nothing is before it."""
    try:
        with os.scandir(folder) as files:
            return min((file.stat().st_mtime for file in files), default=-math.inf)
    except OSError:
        return -math.inf


def _used(folder: Path) -> float:
    try:
        return folder.stat().st_mtime
    except OSError:
        return math.inf


def _read(store: Store, name: str, resolution: int) -> RawOctree | None:
    try:
        return decode_raw(store.read_bytes(name), TARGET, resolution) if store.exists(name) else None
    except OcnfError:
        return None
