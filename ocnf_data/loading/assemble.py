"""The samples of a batch, damaged ones replaced or left out: the torch-free half of what a worker does."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ocnf_data.arrays import I64
from ocnf_data.errors import OcnfError
from ocnf_data.loading.arguments import OnError
from ocnf_data.loading.augment import Augment, draw_symmetry
from ocnf_data.loading.catalogue import Catalogue
from ocnf_data.loading.fetch import Fetcher, RawSample
from ocnf_data.loading.lost import LostSamples
from ocnf_data.loading.order import Partition, Uneven
from ocnf_data.octree.symmetry import Symmetry

NOT_DAMAGE = frozenset({"unreachable", "permission"})
"""Codes of errors that skipping would hide: nothing can be read at all."""


@dataclass(frozen=True)
class Lost:
    """A damaged sample that was left out: its key, and the error's code and sentence."""

    key: str
    code: str
    error: str


@dataclass(frozen=True, eq=False)
class Assembled:
    """The samples of a batch, augmented; `repeat` and `symmetries` have one entry for each."""

    samples: tuple[RawSample, ...]
    repeat: tuple[bool, ...]
    symmetries: tuple[Symmetry, ...]
    lost: tuple[Lost, ...]


class Assembler:
    """Makes any batch of any epoch of one rank; copies in worker processes count losses together.

    Args:
        catalogue: the samples.
        partition: says which of the samples make a batch.
        seed: seed of the augmentation.
        augment: the group of symmetries.
        on_error: what becomes of a damaged sample.
        max_bad_fraction: share of the samples of a rank's epoch that may be lost; one always may.
    """

    def __init__(self, catalogue: Catalogue, partition: Partition, seed: int, augment: Augment,
                 on_error: OnError, max_bad_fraction: float) -> None:
        self._partition = partition
        self._seed, self._augment, self._on_error = seed, augment, on_error
        self._fetcher = Fetcher(catalogue)
        self._keys = catalogue.keys
        met = min(len(catalogue), partition.n_batches * partition.batch_size)
        limit = max(1, int(max_bad_fraction * met))
        self._lost = LostSamples(len(catalogue), limit, "damaged samples", "ShardDataset",
                                 "run `ocnf-data verify`, then `ocnf-data repair`",
                                 "ocnf_data.loading.dataset")

    def assemble(self, order: I64, epoch: int, step: int) -> Assembled:
        """Batch `step` of the epoch whose order is given.

        Raises:
            OcnfError: a sample is damaged, or (code `too_many_bad`) too many of them are.
        """
        places, repeat = self._partition.places(step)
        spares = self._partition.spares(step)
        lost: list[Lost] = []
        fetched = [(self._try(sample, epoch, lost), again)
                   for sample, again in zip(order[places].tolist(), repeat.tolist(), strict=True)]
        own = [sample for sample, _ in fetched if sample is not None]
        good: list[tuple[RawSample, bool]] = []
        for sample, again in fetched:
            if sample is not None:
                good.append((sample, again))
            elif self._partition.uneven is not Uneven.EXACT:
                good.append((self._stand_in(order, epoch, spares, lost, own), True))
        samples = tuple(sample for sample, _ in good)
        symmetries = tuple(draw_symmetry(self._augment, self._seed, epoch, sample.draw) for sample in samples)
        if self._augment is not Augment.NONE:
            samples = tuple(sample.moved(move) for sample, move in zip(samples, symmetries, strict=True))
        return Assembled(samples, tuple(again for _, again in good), symmetries, tuple(lost))

    def lost(self, epoch: int) -> list[str]:
        """Keys of the samples that this rank lost in an epoch, unless a later one lost them again."""
        return [self._keys[sample] for sample in self._lost.of(epoch)]

    def _stand_in(self, order: I64, epoch: int, spares: Iterator[int], lost: list[Lost],
                  own: Sequence[RawSample]) -> RawSample:
        """The next sample behind the batch; where there is none, the batch's own in turn."""
        for place in spares:
            fetched = self._try(int(order[place]), epoch, lost)
            if fetched is not None:
                return fetched
        if own:
            return own[len(lost) % len(own)]
        raise OcnfError("no sample is left to replace a damaged one", code="too_many_bad",
                        where="ShardDataset", found=lost[-1].error)

    def _try(self, sample: int, epoch: int, lost: list[Lost]) -> RawSample | None:
        try:
            return self._fetcher.fetch(sample)
        except OcnfError as error:
            if self._on_error is OnError.RAISE or error.code in NOT_DAMAGE:
                raise
            lost.append(Lost(self._keys[sample], error.code, str(error)))
            self._lost.count(sample, epoch, f"sample left out: {error}", error)
            return None
