"""Which symmetry of the cube a sample is shown in: a pure function of (seed, epoch, key).

Where a mixture meets a key again in an epoch, that showing's own name stands for the key.
"""

from __future__ import annotations

import hashlib
from enum import StrEnum

from ocnf_data.octree.symmetry import ROTATIONS, SYMMETRIES, Symmetry


class Augment(StrEnum):
    """The group that is drawn from. Octrees are moved exactly: structure and values, no resampling."""

    NONE = "none"
    """Samples as they are stored."""
    ROTATIONS = "rotations"
    """The 24 rotations that carry the grid's axes onto one another."""
    FLIPS = "flips"
    """The 8 ways to flip axes, without exchanging them."""
    ALL = "all"
    """All 48: rotations, with or without a mirror."""


_GROUPS: dict[Augment, tuple[Symmetry, ...]] = {
    Augment.NONE: SYMMETRIES[:1],
    Augment.ROTATIONS: ROTATIONS,
    Augment.FLIPS: tuple(symmetry for symmetry in SYMMETRIES if symmetry.axes == (0, 1, 2)),
    Augment.ALL: SYMMETRIES,
}


def draw_symmetry(augment: Augment, seed: int, epoch: int, key: str) -> Symmetry:
    """The symmetry of a sample in an epoch, each of the group equally likely; one for all its octrees."""
    group = _GROUPS[augment]
    digest = hashlib.sha256(f"ocnf augment {seed} {epoch} {key}".encode()).digest()
    return group[int.from_bytes(digest[:8], "little") % len(group)]
