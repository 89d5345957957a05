"""Ground truth that the epochs of a season share, in a folder: a cache, which changes nothing but the time.

    CACHE/<checksum>/season-000004/<SHA-256 of body and resolution>.oct      as `octree.codec` encodes it

Processes write without a word to one another: whole files by rename, and equal names have equal contents.
A season's folder goes when the one after the next begins. Damaged files are made anew.
"""

from __future__ import annotations

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


class TruthCache:
    """Ground truths of the bodies of one source in a folder.

    Args:
        folder: of the cache; it need not exist.
        checksum: of the sources.
    """

    def __init__(self, folder: Path, checksum: str) -> None:
        self._folder, self._checksum = folder / checksum[:16], checksum
        self._season = -1

    def find(self, season: int, body: list[int], resolutions: tuple[int, ...],
             make: Callable[[tuple[int, ...]], Truths]) -> Truths:
        """The ground truths of a body, by resolution: from the cache, or made and kept.

        Args:
            season: that the body is of.
            body: what it was drawn with beside the season: seed, number, attempt.
            resolutions: that are wanted.
            make: makes them for these resolutions.
        """
        self._tidy(season)
        store = Store(self._folder / f"{_PREFIX}{season:06d}")
        names = {resolution: self._name(season, body, resolution) for resolution in resolutions}
        found = {resolution: octree for resolution, name in names.items()
                 if (octree := _read(store, name, resolution)) is not None}
        missing = tuple(resolution for resolution in resolutions if resolution not in found)
        if missing:
            made = make(missing)
            for resolution, octree in made.items():
                store.put_bytes(names[resolution], encode_raw(octree))
            found |= made
        return found

    def _name(self, season: int, body: list[int], resolution: int) -> str:
        return f"{sha256_hex(canonical_json([self._checksum, season, *body, resolution]))}.oct"

    def _tidy(self, season: int) -> None:
        """Remove the seasons that no worker is in any more."""
        if season == self._season:
            return
        self._season = season
        for folder in self._folder.glob(f"{_PREFIX}*"):
            number = folder.name.removeprefix(_PREFIX)
            if number.isdigit() and abs(int(number) - season) > 1:
                shutil.rmtree(folder, ignore_errors=True)


def _read(store: Store, name: str, resolution: int) -> RawOctree | None:
    try:
        return decode_raw(store.read_bytes(name), TARGET, resolution) if store.exists(name) else None
    except OcnfError:
        return None
