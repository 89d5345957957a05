"""A data set's samples by number: in each epoch another order, begun again where it ends."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ocnf_data.loading.catalogue import Catalogue
from ocnf_data.loading.fetch import Fetcher, RawSample
from ocnf_data.loading.order import I64, epoch_order


class ShardSupply:
    """Samples of shards; see `loading.supply.Supply`.

    Number i of an epoch is the i-th sample of the order that `ShardDataset` would meet; behind the last one
    the order goes on from its start. The k-th replacement of a sample is the k-th behind it. Replacements and
    what comes a second time are showings of their own.

    Args:
        catalogue: the samples.
        seed: seed of the samples' order.
        buffer: samples in the window that is shuffled.
        shuffle: whether the samples are shuffled.
        checksum: SHA-256 of the data sets, as `ShardDataset.checksum` gives it.
    """

    def __init__(self, catalogue: Catalogue, seed: int, buffer: int, shuffle: bool, checksum: str) -> None:
        self.request = catalogue.request
        self.checksum = checksum
        self._catalogue, self._fetcher = catalogue, Fetcher(catalogue)
        self._seed, self._buffer, self._shuffle = seed, buffer, shuffle
        self._epoch = -1
        self._order: I64

    @property
    def order(self) -> list[Any]:
        """Seed, buffer and whether it shuffles."""
        return [self._seed, self._buffer, self._shuffle]

    @property
    def manifest(self) -> dict[str, Any]:
        """The manifest of the (first) data set."""
        return self._catalogue.manifest

    def key(self, epoch: int, number: int, attempt: int) -> str:
        """The sample's key."""
        return self._catalogue.keys[self._index(epoch, number, attempt)]

    def part(self, epoch: int, number: int) -> int:
        """There is one alone."""
        return 0

    def sample(self, epoch: int, number: int, attempt: int) -> RawSample:
        """Read, check and decode a sample.

        Raises:
            OcnfError: names the shard, the key, the member and its byte offset.
        """
        sample = self._fetcher.fetch(self._index(epoch, number, attempt))
        again = attempt > 0 or number >= len(self._order)
        return replace(sample, showing=f" {number}") if again else sample

    def _index(self, epoch: int, number: int, attempt: int) -> int:
        if epoch != self._epoch:
            self._order = epoch_order(self._catalogue.shard_sizes, self._seed, epoch, self._buffer,
                                      self._shuffle)
            self._epoch = epoch
        return int(self._order[(number + attempt) % len(self._order)])
