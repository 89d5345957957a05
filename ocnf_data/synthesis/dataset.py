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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.loading.arguments import names, one_of, parse_resolutions, parse_targets, whole
from ocnf_data.loading.catalogue import Request
from ocnf_data.loading.drawn import DrawnDataset
from ocnf_data.manifest import Manifest, load_manifest
from ocnf_data.synthesis.sources import Sources, open_sources
from ocnf_data.synthesis.supply import DRAWN_VARIANT, SynthesisSupply


class SynthesisDataset(DrawnDataset):
    """Batches of samples that are drawn from a manifest's sources (its section `synthesis` says how).

    Sample i of epoch e is a pure function of (manifest, mesh files, seed, e, i): of no other sample, and not
    of ranks, workers, batch size or what was drawn before.

    Args:
        manifest: a manifest, the path of its YAML, or `Sources` opened before.
        resolutions: voxels a side, multiples of 8; they need not be the manifest's.
        encoding: encoding of the inputs.
        meshes: the folder that the manifest's mesh paths are relative to.
        split: whose mesh files, or which of the shapes' endless rows, are drawn from.
        seed: seed of everything that is drawn, any integer from 0.
        batch_size: samples a batch, for each rank.
        rank, world_size: number of this process and number of all that train together, as for `ShardDataset`.
        on_error: "skip" puts another draw in the place of a mesh that cannot be used, logs it and lists it in
            `Batch.lost`; "raise" stops.
        categories: names of the categories to draw from; None for all.
        drop_last: leave out the last, incomplete round of batches instead of filling it with the epoch's
            first samples, marked `repeat`.
        augment: "none", "rotations", "flips" or "all", of the octrees, as for `ShardDataset`.
        max_bad_fraction: with on_error="skip", the run stops when more than this share of the epoch's
            samples, and more than one, had to be replaced.
        cache: folder for the ground truths that epochs share where the manifest says `repeat`; None makes
            them again every time. It changes nothing but the time.
        samples_per_epoch: number of samples in an epoch, instead of the manifest's.
        targets: those of the resolutions that the ground truth is wanted at; True for all.

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
        samples_per_epoch: int | None = None,
        targets: bool | Sequence[int] = True,
    ) -> None:
        where = type(self).__name__
        chosen = None if categories is None else names("categories", categories, where)
        grids = parse_resolutions(resolutions, where)
        request = Request(split=split, resolutions=grids,
                          encoding=one_of(Encoding, "encoding", encoding, where), variant=DRAWN_VARIANT,
                          categories=chosen, targets=parse_targets(targets, grids, where))
        if not isinstance(manifest, Sources):
            if not isinstance(manifest, Manifest):
                manifest = load_manifest(manifest)
            manifest = open_sources(manifest, manifest.meshes_root(meshes), split, chosen)
        if manifest.split != split:
            raise OcnfError("the sources were opened for another split", where="SynthesisDataset",
                            field="split", found=split, expected=manifest.split)
        supply = SynthesisSupply(manifest, request, whole("seed", seed, least=0, where=where),
                                 None if cache is None else Path(cache))
        n_samples = manifest.settings.samples_per_epoch if samples_per_epoch is None else samples_per_epoch
        super().__init__(supply, n_samples, seed=seed, batch_size=batch_size,
                         rank=rank, world_size=world_size, on_error=[on_error], uneven="repeat",
                         drop_last=drop_last, augment=augment, max_bad_fraction=max_bad_fraction)

    def _order(self) -> dict[str, Any]:
        return {"synthesis": self.checksum, "split": self._supply.request.split, **self._drawn_order()}
