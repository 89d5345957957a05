"""Samples by number, whatever they come from, and batches out of them: the torch-free half of the work.

`ShardDataset` alone walks through its shards in an order. What draws its samples instead (from a manifest,
from a mixture) is a `Supply`, and the assembler here makes its batches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from ocnf_data.errors import OcnfError
from ocnf_data.loading.arguments import OnError
from ocnf_data.loading.assemble import NOT_DAMAGE, Assembled, Lost
from ocnf_data.loading.augment import Augment, draw_symmetry
from ocnf_data.loading.catalogue import Request
from ocnf_data.loading.fetch import RawSample
from ocnf_data.loading.lost import LostSamples
from ocnf_data.loading.order import Partition

_MAX_ATTEMPTS = 100


class Supply(Protocol):
    """Samples without end: sample `number` of an epoch is a pure function of (epoch, number)."""

    request: Request
    """What every sample holds."""

    @property
    def checksum(self) -> str:
        """SHA-256 of all that samples depend on."""

    @property
    def order(self) -> list[Any]:
        """What else the sample of a number depends on, such as the seed: JSON values."""

    @property
    def manifest(self) -> dict[str, Any]:
        """The resolved manifest, which says what the values mean."""

    def key(self, epoch: int, number: int, attempt: int) -> str:
        """What `sample` is made of, for messages."""

    def part(self, epoch: int, number: int) -> int:
        """Which part of a mixture the sample is of; 0 where there is one alone."""

    def sample(self, epoch: int, number: int, attempt: int) -> RawSample:
        """A sample.

        Args:
            epoch: number of the epoch, from 0.
            number: number of the sample in the epoch, from 0, without an upper limit.
            attempt: number of the replacement to take, counted from 1; 0 is the sample itself.

        Raises:
            OcnfError: the sample cannot be read or made.
        """


class SupplyAssembler:
    """Makes any batch of any epoch of one rank out of a supply.

    Args:
        supply: where the samples come from.
        partition: says which of an epoch's samples make a batch.
        seed: seed of the augmentation.
        augment: the group of symmetries.
        on_error: what becomes of a sample that cannot be read or made, for each part of the supply.
        lost: counts the lost samples.
    """

    def __init__(self, supply: Supply, partition: Partition, seed: int, augment: Augment,
                 on_error: Sequence[OnError], lost: LostSamples) -> None:
        self._supply, self._partition, self._lost = supply, partition, lost
        self._seed, self._augment, self._on_error = seed, augment, on_error

    def assemble(self, epoch: int, step: int) -> Assembled:
        """Batch `step` of an epoch.

        Raises:
            OcnfError: a sample cannot be read or made, or (code `too_many_bad`) too many cannot.
        """
        places, repeat = self._partition.places(step)
        lost: list[Lost] = []
        samples = tuple(self._sample(epoch, number, lost) for number in places.tolist())
        symmetries = tuple(draw_symmetry(self._augment, self._seed, epoch, sample.draw) for sample in samples)
        if self._augment is not Augment.NONE:
            samples = tuple(sample.moved(move) for sample, move in zip(samples, symmetries, strict=True))
        return Assembled(samples, tuple(repeat.tolist()), symmetries, tuple(lost))

    def _sample(self, epoch: int, number: int, lost: list[Lost]) -> RawSample:
        for attempt in range(_MAX_ATTEMPTS):
            try:
                return self._supply.sample(epoch, number, attempt)
            except OcnfError as error:
                policy = self._on_error[self._supply.part(epoch, number)]
                if policy is OnError.RAISE or error.code in NOT_DAMAGE:
                    raise
                key = self._supply.key(epoch, number, attempt)
                lost.append(Lost(key, error.code, str(error)))
                self._lost.count(number, epoch, f"another sample takes the place of {key}: {error}", error)
        raise OcnfError("no replacement could be made either", code="too_many_bad", found=lost[-1].error)
