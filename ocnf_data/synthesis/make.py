"""The samples of a batch, bad meshes replaced by another draw: the torch-free half of what a worker does."""

from __future__ import annotations

import logging
import multiprocessing
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.loading.arguments import OnError
from ocnf_data.loading.assemble import Assembled, Lost
from ocnf_data.loading.augment import Augment, draw_symmetry
from ocnf_data.loading.catalogue import Request
from ocnf_data.loading.fetch import RawSample
from ocnf_data.loading.order import Partition
from ocnf_data.octree.stored import RawOctree
from ocnf_data.shards.tarformat import input_member, target_member
from ocnf_data.synthesis.draw import Body, Look, draw_body, draw_look, season_of
from ocnf_data.synthesis.sample import make_inputs, make_truths, pose
from ocnf_data.synthesis.sources import Sources
from ocnf_data.synthesis.truths import TruthCache

VARIANT = "synthesis"
"""What stands in a synthetic input's member name for the variant's."""

_log = logging.getLogger("ocnf_data.synthesis.dataset")
_MAX_ATTEMPTS = 100
# Drawing another mesh would hide that nothing can be read at all.
_NOT_BAD_MESHES = frozenset({"unreachable", "permission"})


class Maker:
    """Makes any batch of any epoch of one rank; copies in worker processes count losses together.

    Args:
        sources: what samples are made of.
        request: what is wanted of every sample.
        partition: which samples make a batch.
        seed: of everything that is drawn.
        augment: the group of symmetries.
        on_error: what becomes of a mesh that cannot be used.
        max_bad_fraction: share of the samples of a rank's epoch that may be drawn anew; one always may.
        cache: folder of the ground truths that epochs share, or None.
    """

    def __init__(self, sources: Sources, request: Request, partition: Partition, seed: int, augment: Augment,
                 on_error: OnError, max_bad_fraction: float, cache: Path | None) -> None:
        self._sources, self._request, self._partition = sources, request, partition
        self._seed, self._augment, self._on_error = seed, augment, on_error
        self._repeat = sources.settings.repeat
        self._cache = None if cache is None or self._repeat == 1 else TruthCache(cache, sources.checksum)
        met = min(partition.n_samples, partition.n_batches * partition.batch_size)
        self._limit = max(1, int(max_bad_fraction * met))
        # Last epoch, counted from 1, in which each sample was drawn anew. Workers write without a lock: two
        # that lose the same sample write the same number. Of a spawn context, which works under fork too.
        self._lost_in = multiprocessing.get_context("spawn").RawArray("q", partition.n_samples)

    def assemble(self, epoch: int, step: int) -> Assembled:
        """Batch `step` of an epoch.

        Raises:
            OcnfError: a mesh cannot be used, or (code `too_many_bad`) too many cannot.
        """
        places, repeat = self._partition.places(step)
        lost: list[Lost] = []
        samples = tuple(self.sample(epoch, number, lost) for number in places.tolist())
        symmetries = tuple(draw_symmetry(self._augment, self._seed, epoch, sample.key) for sample in samples)
        if self._augment is not Augment.NONE:
            samples = tuple(sample.moved(move) for sample, move in zip(samples, symmetries, strict=True))
        return Assembled(samples, tuple(repeat.tolist()), symmetries, tuple(lost))

    def sample(self, epoch: int, number: int, lost: list[Lost]) -> RawSample:
        """Sample `number` of an epoch, before augmentation; `lost` gets the meshes that cannot be used."""
        season = season_of(epoch, self._repeat)
        look = draw_look(self._sources, self._seed, epoch, number)
        for attempt in range(_MAX_ATTEMPTS):
            body = draw_body(self._sources, self._seed, season, number, attempt)
            try:
                return self._make(body, look, season, epoch, number, attempt)
            except OcnfError as error:
                if self._on_error is OnError.RAISE or error.code in _NOT_BAD_MESHES:
                    raise
                lost.append(Lost(body.item.key, error.code, str(error)))
                self._count(body, epoch, number, error)
        raise OcnfError("no draw gave a mesh that can be used", code="too_many_bad", where="SynthesisDataset",
                        found=lost[-1].error)

    def lost(self, epoch: int) -> list[int]:
        """Numbers of the samples that were drawn anew in an epoch, unless they were again in a later one."""
        return np.flatnonzero(np.frombuffer(self._lost_in, np.int64) == epoch + 1).tolist()

    def _make(self, body: Body, look: Look, season: int, epoch: int, number: int, attempt: int) -> RawSample:
        manifest, request = self._sources.manifest, self._request
        assert request.encoding is not None
        posed = pose(manifest, body, self._sources.meshes)

        def make(resolutions: tuple[int, ...]) -> dict[int, RawOctree]:
            return make_truths(manifest, posed, resolutions)

        truths = make(request.resolutions) if self._cache is None else self._cache.find(
            season, [self._seed, number, attempt], request.resolutions, make)
        inputs = make_inputs(manifest, posed, look, request.encoding, request.resolutions)
        octrees = {target_member(resolution): octree for resolution, octree in truths.items()}
        octrees |= {input_member(VARIANT, request.encoding, resolution): octree
                    for resolution, octree in inputs.items()}
        key = f"{body.item.key}-{epoch}-{number}"
        return RawSample(key, body.item.category, _facts(key, body, look), octrees)

    def _count(self, body: Body, epoch: int, number: int, error: OcnfError) -> None:
        lost_in = np.frombuffer(self._lost_in, np.int64)
        lost_in[number] = epoch + 1
        _log.warning("%s cannot be used, another mesh takes its place: %s", body.item.source, error)
        count = int((lost_in == epoch + 1).sum())
        if count > self._limit:
            raise OcnfError("too many bad meshes in one epoch", code="too_many_bad",
                            where="SynthesisDataset", field="max_bad_fraction",
                            found=f"{count}, the last: {error}", expected=f"at most {self._limit}",
                            fix="run `ocnf-data generate` on the manifest: its failures.jsonl names all of "
                                "them") from None


def _facts(key: str, body: Body, look: Look) -> dict[str, Any]:
    """What `Batch.meta` says of a sample: JSON values."""
    item = body.item
    return {
        "key": key, "split": item.split, "category": item.category, "source": item.source,
        "rotation": None if body.rotation is None else body.rotation.tolist(), "scale": body.scale,
        "directions": look.directions.tolist(), "views": list(look.views), "sigma": look.sigma,
        "noise": str(look.noise),
    }
