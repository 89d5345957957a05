"""The loader's batches straight from a manifest: samples that are made as they are needed, without end.

>>> dataset = SynthesisDataset("manifest.yaml", [64], "histogram", meshes="meshes", batch_size=4)
...                                                                                        # doctest: +SKIP
>>> loader = DataLoader(dataset, batch_size=None, num_workers=2, persistent_workers=True)  # doctest: +SKIP
>>> for epoch in range(50):                                                                # doctest: +SKIP
...     for batch in loader:
...         state = dataset.state_dict(batch)

Batches, epochs, ranks, workers and states are those of `ShardDataset`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numba
from torch.utils.data import get_worker_info

from ocnf_data.encodings import Encoding
from ocnf_data.loading.arguments import OnError, fraction, names, one_of, parse_resolutions, whole
from ocnf_data.loading.augment import Augment
from ocnf_data.loading.batch import Batch, make_batch
from ocnf_data.loading.catalogue import Request
from ocnf_data.loading.epochs import EpochDataset, place_in_world
from ocnf_data.loading.order import Partition, Uneven
from ocnf_data.manifest import Manifest, load_manifest
from ocnf_data.synthesis.make import VARIANT, Maker
from ocnf_data.synthesis.sources import Sources, open_sources


class SynthesisDataset(EpochDataset):
    """Batches of samples that are drawn from a manifest's sources (its section `synthesis` says how).

    Sample i of epoch e is a pure function of (manifest, mesh files, seed, e, i): of no other sample, and not
    of ranks, workers, batch size or what was drawn before.

    Args:
        manifest: a manifest, the path of its YAML, or `Sources` opened before.
        resolutions: voxels a side, multiples of 8; they need not be the manifest's.
        encoding: of the inputs.
        meshes: the folder that the manifest's mesh paths are relative to.
        split: whose mesh files, or which of the shapes' endless rows, are drawn from.
        seed: of everything that is drawn; 0 is a seed like any other.
        batch_size: samples a batch, for each rank.
        rank, world_size: as for `ShardDataset`.
        on_error: "skip" puts another draw in the place of a mesh that cannot be used, logs it and lists it in
            `Batch.lost`; "raise" stops.
        categories: which of them; None for all.
        drop_last: leave out the last, incomplete round of batches instead of filling it with the epoch's
            first samples, marked `repeat`.
        augment: "none", "rotations", "flips" or "all", of the octrees, as for `ShardDataset`.
        max_bad_fraction: with on_error="skip", the run stops when more than this share of the epoch's
            samples, and more than one, had to be drawn anew.
        cache: folder for the ground truths that epochs share where the manifest says `repeat`; None makes
            them anew every time. It changes nothing but the time.

    Raises:
        OcnfError: a setting is impossible, the meshes are missing, or nothing is left to draw from.
    """

    def __init__(
        self,
        manifest: Manifest | Sources | str | os.PathLike[str],
        resolutions: int | Sequence[int],
        encoding: Encoding | str,
        *,
        meshes: str | os.PathLike[str] | None = None,
        split: str = "train",
        seed: int = 0,
        batch_size: int = 1,
        rank: int | None = None,
        world_size: int | None = None,
        on_error: str = "skip",
        categories: Sequence[str] | None = None,
        drop_last: bool = False,
        augment: str = "none",
        max_bad_fraction: float = 0.05,
        cache: str | os.PathLike[str] | None = None,
    ) -> None:
        chosen = None if categories is None else names("categories", categories)
        request = Request(split=split, resolutions=parse_resolutions(resolutions),
                          encoding=one_of(Encoding, "encoding", encoding), variant=VARIANT,
                          categories=chosen, targets=True)
        rank, world_size = place_in_world(rank, world_size)
        self._seed = whole("seed", seed, least=0)
        self._augment = one_of(Augment, "augment", augment)
        policy = one_of(OnError, "on_error", on_error)
        bad_share = fraction("max_bad_fraction", max_bad_fraction)
        batch_size = whole("batch_size", batch_size, least=1)
        if not isinstance(manifest, Sources):
            if not isinstance(manifest, Manifest):
                manifest = load_manifest(manifest)
            manifest = open_sources(manifest, manifest.meshes_root(meshes), split, chosen)
        self._sources = manifest
        super().__init__(Partition(manifest.settings.samples_per_epoch, batch_size, rank, world_size,
                                   Uneven.DROP if drop_last else Uneven.REPEAT))
        self._request = request
        self._maker = Maker(manifest, request, self._partition, self._seed, self._augment, policy, bad_share,
                            None if cache is None else Path(cache))

    def _batches(self, epoch: int, steps: range) -> Iterator[Batch]:
        if get_worker_info() is not None:
            # A worker is one process of several: one thread each. That also keeps out of numba's thread
            # pool, which would not survive the fork.
            numba.set_num_threads(1)
        for step in steps:
            yield make_batch(self._maker.assemble(epoch, step), self._request, epoch, step)

    def _order(self) -> dict[str, Any]:
        request, partition = self._request, self._partition
        return {
            "synthesis": self._sources.checksum,
            "split": request.split,
            "resolutions": list(request.resolutions),
            "encoding": str(request.encoding),
            "n_samples": partition.n_samples,
            "seed": self._seed,
            "augment": str(self._augment),
            "batch_size": partition.batch_size,
            "world_size": partition.world_size,
            "uneven": str(partition.uneven),
        }

    @property
    def checksum(self) -> str:
        """SHA-256 of what samples are made of and how; beside it, they depend on the arguments alone."""
        return self._sources.checksum

    @property
    def manifest(self) -> dict[str, Any]:
        """The resolved manifest, with its `synthesis` section."""
        return self._sources.manifest.to_dict()

    @property
    def variant(self) -> str:
        """Name of the inputs in `Batch.slots`."""
        return VARIANT

    def lost(self, epoch: int) -> list[int]:
        """Numbers of the samples that this rank, all its workers together, had to draw anew in an epoch."""
        return self._maker.lost(epoch)
