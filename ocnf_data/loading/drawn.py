"""Batches out of a supply of samples: what `SynthesisDataset` and `MixtureDataset` share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numba
from torch.utils.data import get_worker_info

from ocnf_data.loading.arguments import OnError, bad_setting, flag, fraction, one_of, whole
from ocnf_data.loading.augment import Augment
from ocnf_data.loading.batch import Batch, make_batch
from ocnf_data.loading.epochs import EpochDataset, place_in_world
from ocnf_data.loading.lost import LostSamples
from ocnf_data.loading.order import Partition, Uneven
from ocnf_data.loading.supply import Supply, SupplyAssembler


class DrawnDataset(EpochDataset):
    """Batches in epochs of a length that is given, out of a supply that has no end.

    Args:
        supply: where the samples come from.
        n_samples: number of samples that make an epoch, of all ranks together.
        seed: seed of the augmentation, and of whatever the supply draws.
        batch_size: samples a batch, for each rank.
        rank: number of this process, from 0, or None, with the same meaning as for `ShardDataset`.
        world_size: number of processes that train together, or None.
        on_error: for each part of the supply "raise", or "skip" for another draw in place of a sample that
            cannot be read or made.
        uneven: "repeat" or "exact", as for `ShardDataset`.
        drop_last: leave out the last, incomplete round of batches.
        augment: "none", "rotations", "flips" or "all".
        max_bad_fraction: with on_error="skip", the share of the samples that this rank meets in an epoch
            (and at least one) that may be replaced before the run stops.
    """

    def __init__(self, supply: Supply, n_samples: int, *, seed: int, batch_size: int, rank: int | None,
                 world_size: int | None, on_error: Sequence[str], uneven: str, drop_last: bool,
                 augment: str, max_bad_fraction: float) -> None:
        self._supply = supply
        where = type(self).__name__
        self._seed = whole("seed", seed, least=0, where=where)
        self._augment = one_of(Augment, "augment", augment, where)
        tail = one_of(Uneven, "uneven", uneven, where)
        if flag("drop_last", drop_last, where) and tail is Uneven.EXACT:
            raise bad_setting("an exact epoch drops nothing", "drop_last", True, "False", where)
        rank, world_size = place_in_world(rank, world_size, where)
        partition = Partition(whole("samples_per_epoch", n_samples, least=1, where=where),
                              whole("batch_size", batch_size, least=1, where=where),
                              rank, world_size, Uneven.DROP if drop_last else tail, where)
        super().__init__(partition)
        met = min(partition.n_samples, partition.n_batches * partition.batch_size)
        limit = max(1, int(fraction("max_bad_fraction", max_bad_fraction, where) * met))
        self._lost = LostSamples(partition.n_samples, limit, "bad samples", where,
                                 "`ocnf-data generate` names all bad meshes of a manifest in failures.jsonl, "
                                 "`ocnf-data verify` all that is damaged in a data set",
                                 type(self).__module__)
        policies = [one_of(OnError, "on_error", one, where) for one in on_error]
        self._assembler = SupplyAssembler(supply, partition, self._seed, self._augment, policies, self._lost)

    def _batches(self, epoch: int, steps: range) -> Iterator[Batch]:
        if get_worker_info() is not None:
            # A worker is one process of several: one thread each. That also keeps out of numba's thread
            # pool, which would not survive the fork.
            numba.set_num_threads(1)
        for step in steps:
            yield make_batch(self._assembler.assemble(epoch, step), self._supply.request, epoch, step)

    def _drawn_order(self) -> dict[str, Any]:
        """What batches depend on, whatever the supply."""
        request, partition = self._supply.request, self._partition
        order: dict[str, Any] = {
            "resolutions": list(request.resolutions),
            "encoding": str(request.encoding),
            "n_samples": partition.n_samples,
            "seed": self._seed,
            "augment": str(self._augment),
            "batch_size": partition.batch_size,
            "world_size": partition.world_size,
            "uneven": str(partition.uneven),
        }
        if partition.uneven is Uneven.EXACT:  # ranks differ in length, so a step means another place in each
            order["rank"] = partition.rank
        return order

    def supply(self) -> Supply:
        """The samples by number, for use as a part of a `MixtureDataset`."""
        return self._supply

    @property
    def checksum(self) -> str:
        """SHA-256 of what samples are made of and how; beside it, they depend on the arguments alone."""
        return self._supply.checksum

    @property
    def manifest(self) -> dict[str, Any]:
        """The resolved manifest: truncation, extent, target, ..."""
        return self._supply.manifest

    @property
    def variant(self) -> str | None:
        """What stands in the inputs' member names."""
        return self._supply.request.variant

    def lost(self, epoch: int) -> list[int]:
        """Numbers of the samples that this rank, all its workers together, had to replace in an epoch."""
        return self._lost.of(epoch)

