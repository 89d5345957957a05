"""Which frames of a sequence go into which input: splits in time, and random subsets within each.

The frames of two splits never meet: the sequence is cut in time, in proportion to the configurations that
each split has. Within a split the frames are dealt out like cards: shuffled, and cut into subsets that share
no frame. Where there are to be more subsets than one deal gives, the frames are shuffled and dealt again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass

from ocnf_data.errors import OcnfError


def split_in_time(n_frames: int, counts: Mapping[str, int], stretches: int = 1,
                  gap: int = 0) -> dict[str, tuple[int, ...]]:
    """The frames that each split draws from.

    The sequence is cut into equal stretches of time, and each of these, in the order of `counts`, into a run
    of frames for each split, in proportion to its count. The last `gap` frames of a run are nobody's where a
    run of another split follows, so that frames of different splits are more than `gap` apart.

    Args:
        n_frames: number of frames, numbered 0 .. n_frames - 1 in the order of time.
        counts: number of configurations of each split; a split with 0 gets no frames.
        stretches: number of stretches; with more than one each split sees the whole path of the camera.
        gap: number of frames.

    Returns:
        Ascending positions, by split.

    >>> split_in_time(10, {"train": 3, "test": 2}, gap=1)
    {'train': (0, 1, 2, 3, 4), 'test': (6, 7, 8, 9)}
    """
    wanted = {split: count for split, count in counts.items() if count}
    total = sum(wanted.values())
    runs: list[tuple[str, int, int]] = []
    for stretch in range(stretches):
        start, stop = (n_frames * edge // stretches for edge in (stretch, stretch + 1))
        before = 0
        for split, count in wanted.items():
            first, last = (start + (stop - start) * share // total for share in (before, before + count))
            before += count
            if first < last:
                runs.append((split, first, last))
    found: dict[str, list[int]] = {split: [] for split in wanted}
    for i, (split, first, last) in enumerate(runs):
        follows_another = i + 1 < len(runs) and runs[i + 1][0] != split
        found[split] += range(first, max(first, last - gap) if follows_another else last)
    return {split: tuple(frames) for split, frames in found.items()}


@dataclass(frozen=True)
class Deal:
    """Random subsets of some frames.

    Attributes:
        frames: positions of the frames to draw from.
        size: frames in a subset.
        name: what the draw depends on beside `frames`: values that JSON can hold, such as the seed.
    """

    frames: tuple[int, ...]
    size: int
    name: tuple[object, ...]

    @property
    def n_disjoint(self) -> int:
        """How many subsets a deal gives that share no frame."""
        return len(self.frames) // self.size

    def check(self, n: int, disjoint: bool, where: object, split: str) -> None:
        """Raise OcnfError, with figures, where there are too few frames for n subsets.

        Args:
            n: number of subsets.
            disjoint: whether all of them are to share no frame.
            where: the scan, for the message.
            split: the split, for the message.
        """
        needed = self.size * (n if disjoint else 1)
        if len(self.frames) >= needed:
            return
        subsets = f"{n} configurations of {self.size} views" + " without a common frame" * disjoint
        fix = f"ask for fewer views than {self.size}, or for a larger share of the scan"
        if disjoint and self.n_disjoint:
            fix = (f"ask for at most {self.n_disjoint} configurations, or say `disjoint: false`, which deals "
                   "the frames out again when all are used")
        raise OcnfError("too few frames", code="empty", where=where, field=f"source.configurations.{split}",
                        found=f"{len(self.frames)} frames for {split}",
                        expected=f"at least {needed}, for {subsets}", fix=fix)

    def subset(self, i: int) -> tuple[int, ...]:
        """Subset number i, in a random order, so that its first k frames are a random subset too.

        Subsets 0 .. n_disjoint - 1 share no frame, nor do the next n_disjoint, and so on.
        """
        deal, place = divmod(i, self.n_disjoint)
        shuffled = sorted(self.frames, key=lambda frame: self._rank(deal, frame))
        return tuple(shuffled[place * self.size:(place + 1) * self.size])

    def _rank(self, deal: int, frame: int) -> str:
        """Sorting by a hash shuffles without a library's random numbers, which may change."""
        return hashlib.sha256(json.dumps([*self.name, deal, frame]).encode()).hexdigest()

