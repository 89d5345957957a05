"""The order in which an epoch's samples are met, and which of them make batch i of rank r.

Both are pure functions; nothing here knows of workers, files or time.

*Order.* The shards are permuted, their samples are strung together, and the string is cut into windows of
`buffer` samples, each of which is permuted. So at any time a reader is busy with the few shards that a window
spans, and needs none of the samples in memory: it fetches them by index. Weaknesses: samples of a shard stay
within about a window of one another, hence the larger the buffer (or the smaller the shards) the better the
mix; and the last window of an epoch may be short.

*Batches.* With the order o, batch i of rank r is o[(i world + r) B : (i world + r + 1) B]: all ranks together
walk along the order, so what the job has seen after i steps does not depend on how it is cut into ranks, as
long as world * B stays the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ocnf_data.arrays import I64, U64, Bool
from ocnf_data.errors import OcnfError


class Uneven(StrEnum):
    """What becomes of the last samples where `world * batch` does not divide their number."""

    REPEAT = "repeat"
    """Every rank gets ceil(N / (world B)) batches; the first samples of the order come again, marked."""
    DROP = "drop"
    """Every rank gets floor(N / (world B)) batches; the order's last samples are left out of the epoch."""
    EXACT = "exact"
    """Each sample exactly once; some ranks get one batch less, one rank a shorter last batch."""


def epoch_order(shard_sizes: Sequence[int] | I64, seed: int, epoch: int, buffer: int,
                shuffle: bool = True) -> I64:
    """The samples of all shards in the order of an epoch.

    Args:
        shard_sizes: samples of each shard; sample ids count through the shards in this order.
        seed: any integer from 0, like the epoch; each pair of them has its own order.
        epoch: number of the epoch, from 0.
        buffer: samples in a window, at least 1 (1 permutes the shards alone).
        shuffle: False gives 0 .. N-1, in every epoch.

    Returns:
        (N,) int64, a permutation of 0 .. N-1.
    """
    sizes = np.asarray(shard_sizes, np.int64)
    n_samples = int(sizes.sum())
    if not shuffle:
        return np.arange(n_samples)
    first = np.cumsum(sizes) - sizes
    shards = np.argsort(_draws(len(sizes), seed, epoch, "shards"), kind="stable")
    # shard s is the run first[s], first[s] + 1, ...: the place, plus (first[s] - the run's first place)
    lengths = sizes[shards]
    place = np.arange(n_samples)
    string = place + np.repeat(first[shards] - (np.cumsum(lengths) - lengths), lengths)
    return string[np.lexsort((_draws(n_samples, seed, epoch, "samples"), place // buffer))]


def _draws(n: int, seed: int, epoch: int, purpose: str) -> U64:
    """`n` random words. Sorting by them permutes, and unlike `Generator.permutation`, whose stream numpy may
    change, the words of a bit generator are promised to stay: a state resumes under a later numpy too.
    """
    key = hashlib.sha256(f"ocnf order {purpose} {seed} {epoch}".encode()).digest()[:16]
    return np.random.Philox(key=int.from_bytes(key, "little")).random_raw(n).astype(np.uint64)


@dataclass(frozen=True)
class Partition:
    """Who gets what of an epoch of `n_samples`.

    Attributes:
        n_samples: N, at least 1.
        batch_size: B, samples a batch.
        rank, world_size: this process among those that train together.
        uneven: what becomes of the last samples.
        where: whose batches they are, for messages.
    """

    n_samples: int
    batch_size: int
    rank: int
    world_size: int
    uneven: Uneven
    where: str = "ShardDataset"

    def __post_init__(self) -> None:
        """Refuse what gives no batches."""
        for field, found, least in (("batch_size", self.batch_size, 1), ("world_size", self.world_size, 1),
                                    ("rank", self.rank, 0)):
            if isinstance(found, bool) or not isinstance(found, int) or found < least:
                raise OcnfError("not a number of that kind", where=self.where, field=field, found=found,
                                expected=f"an integer, at least {least}")
        if self.rank >= self.world_size:
            raise OcnfError("there is no such rank", where=self.where, field="rank", found=self.rank,
                            expected=f"0 to {self.world_size - 1}")
        if self.uneven is Uneven.DROP and self.n_batches == 0:
            raise OcnfError("drop_last leaves nothing", code="empty", where="ShardDataset",
                            found=f"{self.n_samples} samples",
                            expected=f"at least {self.world_size * self.batch_size}",
                            fix="lower the batch size, or fill the last batch (drop_last=False)")

    @property
    def n_batches(self) -> int:
        """Batches of this rank in an epoch."""
        stride = self.world_size * self.batch_size
        if self.uneven is Uneven.DROP:
            return self.n_samples // stride
        if self.uneven is Uneven.REPEAT:
            return -(-self.n_samples // stride)
        return max(0, -(-(self.n_samples - self.rank * self.batch_size) // stride))

    def places(self, step: int) -> tuple[I64, Bool]:
        """Batch `step` (0 .. n_batches - 1) of this rank.

        Returns:
            (places in the order, (B,) int64, or fewer at the end of an exact epoch;
            whether each is a repetition, (B,) bool).
        """
        start = (step * self.world_size + self.rank) * self.batch_size
        places = np.arange(start, start + self.batch_size)
        if self.uneven is Uneven.EXACT:
            places = places[places < self.n_samples]
        return places % self.n_samples, places >= self.n_samples

    def spares(self, step: int) -> Iterator[int]:
        """Places whose samples may replace lost ones of batch `step`: what follows it in the order, and
        on from the start, without the batch's own. The same for any number of workers.
        """
        own = set(self.places(step)[0].tolist())
        start = (step * self.world_size + self.rank + 1) * self.batch_size
        for place in range(start, start + self.n_samples):
            if place % self.n_samples not in own:
                yield place % self.n_samples
