"""Rendered views as `generate` keeps them: `FILE.h5::KEY`."""

from __future__ import annotations

from ocnf_data.views.scans.scan import Scan
from ocnf_data.views.scans.selection import choose
from ocnf_data.views.store import read_kept


def is_kept(place: str) -> bool:
    """Whether a place is of this kind."""
    path, separator, _ = place.partition("::")
    return bool(separator) or path.endswith((".h5", ".hdf5"))


def read_kept_views(place: str, frames: str | int | None = None, every: int = 1) -> Scan:
    """The views of an item, with the cube that they were rendered for.

    Raises:
        OcnfError: the views cannot be read (see `ocnf_data.views.store`).
    """
    kept = read_kept(place)
    chosen = choose(len(kept.views), frames, every)
    return Scan(kept.views.subset(chosen), tuple(f"view {i}" for i in chosen),
                cube=((0.0, 0.0, 0.0), kept.extent), format="kept")
