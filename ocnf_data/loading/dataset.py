"""The streaming loader: shards in, batches of octrees out, in an order that is a function of (seed, epoch).

>>> dataset = ShardDataset("out", "train", [64, 128], "histogram", batch_size=4)           # doctest: +SKIP
>>> loader = DataLoader(dataset, batch_size=None, num_workers=2, persistent_workers=True)  # doctest: +SKIP
>>> for epoch in range(50):                                                                # doctest: +SKIP
...     for batch in loader:
...         batch = batch.to("cuda")
...         batch.inputs[64].trees, batch.inputs[64].to_float(), batch.targets[64].to_float()
...         state = dataset.state_dict(batch)           # JSON: resumes at the batch after this one

Batches are formed here (see `loading.epochs`), so the `DataLoader` gets `batch_size=None`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from typing import Any

from ocnf_data.encodings import Encoding
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.loading.arguments import (
    OnError,
    bad_setting,
    flag,
    fraction,
    names,
    one_of,
    parse_resolutions,
    parse_targets,
    whole,
)
from ocnf_data.loading.assemble import Assembler, Lost
from ocnf_data.loading.augment import Augment
from ocnf_data.loading.batch import Batch, Octrees, make_batch
from ocnf_data.loading.catalogue import Request, open_catalogue
from ocnf_data.loading.epochs import EpochDataset, place_in_world
from ocnf_data.loading.order import Partition, Uneven, epoch_order
from ocnf_data.loading.shard_supply import ShardSupply

__all__ = ["Batch", "Lost", "Octrees", "ShardDataset"]


class ShardDataset(EpochDataset):
    """Batches out of one or more data sets that `generate` made.

    Args:
        urls: folder or fsspec URL of a data set, or several of them, taken as one.
        split: `train`, `val` or `test`.
        resolutions: the resolutions to read, voxels along each axis; only these are decoded.
        encoding: encoding of the inputs (`occupancy`, `tsdf`, `tdf_occupancy`, `histogram`); None for no
            inputs.
        variant: name of the inputs in the manifest; None for the only one that has the encoding.
        seed: seed of the samples' order and of the augmentation, any integer from 0.
        batch_size: samples a batch, for each rank.
        rank: number of this process, from 0; None takes it, like world_size, from torch.distributed if that
            is initialised, else from RANK and WORLD_SIZE in the environment, else 0 of 1.
        world_size: processes that train together.
        on_error: "raise" stops at a damaged sample, with shard, key, member and offset. "skip" leaves it out,
            logs it and lists it in `Batch.lost`; in its place comes the next sample of the epoch's order
            from behind the batch, marked `repeat`, so that ranks stay equal in length (with uneven="exact",
            where ranks may differ, nothing does: the batch is shorter, and may be empty).
        categories: names of the categories to read; None for all.
        targets: False leaves out the ground truth; or those of the resolutions that it is wanted at.
        shuffle: False meets the samples in the data sets' own order, in every epoch.
        buffer: samples in the window that is shuffled (see `loading.order`).
        uneven: "repeat" gives every rank ceil(N / (world_size batch_size)) batches, filled up with the first
            samples of the epoch's order, marked `repeat`. "exact", for evaluation, gives each sample exactly
            once; ranks may differ by one batch.
        drop_last: leave out the samples of the last, incomplete round of batches instead of filling it up.
        augment: "none", "rotations" (24), "flips" (8) or "all" (48): one symmetry for all octrees of a
            sample, drawn from (seed, epoch, key).
        max_bad_fraction: with on_error="skip", the run stops when more than this share of the samples that
            this rank meets in an epoch is lost, and more than one sample.

    Raises:
        OcnfError: a setting is impossible, or the data sets do not have what is asked for.

    *Errors in workers* are raised in the main process as they are without workers, with `code`, `where` and
    all other parts.

    *Epochs.* Each `iter(loader)` (or `iter(dataset)`) is the next epoch, from 0 on, or from where `set_epoch`
    says. This holds with and without workers, persistent or not (see `loading.cursor`). Call `set_epoch` and
    `load_state_dict` before `iter`: workers begin to prefetch at once.
    """

    def __init__(
        self,
        urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
        split: str,
        resolutions: int | Sequence[int],
        encoding: Encoding | str | None,
        variant: str | None = None,
        seed: int = 0,
        batch_size: int = 1,
        rank: int | None = None,
        world_size: int | None = None,
        on_error: str = "raise",
        *,
        categories: Sequence[str] | None = None,
        targets: bool | Sequence[int] = True,
        shuffle: bool = True,
        buffer: int = 1024,
        uneven: str = "repeat",
        drop_last: bool = False,
        augment: str = "none",
        max_bad_fraction: float = 0.05,
    ) -> None:
        grids = parse_resolutions(resolutions)
        request = Request(
            split=split,
            resolutions=grids,
            encoding=None if encoding is None else one_of(Encoding, "encoding", encoding),
            variant=variant,
            categories=None if categories is None else names("categories", categories),
            targets=parse_targets(targets, grids),
        )
        if encoding is None and not request.targets:
            raise bad_setting("nothing is asked for", "encoding", None, "an encoding, or targets=True")
        if encoding is None and variant is not None:
            raise bad_setting("it would have no effect: no inputs are asked for", "variant", variant,
                              "None, or an encoding")
        self._seed = whole("seed", seed, least=0)
        self._buffer = whole("buffer", buffer, least=1)
        self._shuffle = flag("shuffle", shuffle)
        tail = one_of(Uneven, "uneven", uneven)
        if flag("drop_last", drop_last) and tail is Uneven.EXACT:
            raise bad_setting("an exact epoch drops nothing", "drop_last", True, "False")
        rank, world_size = place_in_world(rank, world_size)
        self._augment = one_of(Augment, "augment", augment)
        policy = one_of(OnError, "on_error", on_error)
        bad_share = fraction("max_bad_fraction", max_bad_fraction)
        batch_size = whole("batch_size", batch_size, least=1)

        self._catalogue = open_catalogue(names("urls", urls), request)
        super().__init__(Partition(len(self._catalogue), batch_size, rank, world_size,
                                   Uneven.DROP if drop_last else tail))
        self._assembler = Assembler(self._catalogue, self._partition, self._seed, self._augment, policy,
                                    bad_share)

    def _batches(self, epoch: int, steps: range) -> Iterator[Batch]:
        catalogue = self._catalogue
        order = epoch_order(catalogue.shard_sizes, self._seed, epoch, self._buffer, self._shuffle)
        for step in steps:
            yield make_batch(self._assembler.assemble(order, epoch, step), catalogue.request, epoch, step)

    def _order(self) -> dict[str, Any]:
        request, partition = self._catalogue.request, self._partition
        order: dict[str, Any] = {
            "datasets": list(self._catalogue.datasets),
            "split": request.split,
            "categories": None if request.categories is None else list(request.categories),
            "resolutions": list(request.resolutions),
            "encoding": None if request.encoding is None else str(request.encoding),
            "variant": request.variant,
            "targets": bool(request.targets),
            "n_samples": partition.n_samples,
            "seed": self._seed,
            "shuffle": self._shuffle,
            "buffer": self._buffer,
            "augment": str(self._augment),
            "batch_size": partition.batch_size,
            "world_size": partition.world_size,
            "uneven": str(partition.uneven),
        }
        if partition.uneven is Uneven.EXACT:  # ranks differ in length, so a step means another place in each
            order["rank"] = partition.rank
        return order

    def supply(self) -> ShardSupply:
        """The samples by number, for use as a part of a `MixtureDataset`."""
        return ShardSupply(self._catalogue, self._seed, self._buffer, self._shuffle, self.checksum)

    # ---- what is in it

    @property
    def checksum(self) -> str:
        """The checksum in the data set's `dataset.json`; for several data sets, the SHA-256 of theirs."""
        first, *others = self._catalogue.datasets
        return sha256_hex(canonical_json([first, *others])) if others else first

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of all samples, of all ranks, in the data sets' own order."""
        return tuple(self._catalogue.keys)

    @property
    def manifest(self) -> dict[str, Any]:
        """The resolved manifest of the (first) data set: truncation, extent, target, inputs, ..."""
        return self._catalogue.manifest

    @property
    def variant(self) -> str | None:
        """Name of the inputs."""
        return self._catalogue.request.variant

    def lost(self, epoch: int) -> list[str]:
        """Keys of the samples that this rank, all its workers together, left out in an epoch as damaged."""
        return self._assembler.lost(epoch)
