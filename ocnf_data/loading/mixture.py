"""Several data sets as one, each drawn from as often as its weight says.

>>> paper = ShardDataset("out", "train", [64], "histogram", variant="v4_n02")              # doctest: +SKIP
>>> drawn = SynthesisDataset("manifest.yaml", [64], "histogram", meshes="meshes")          # doctest: +SKIP
>>> mixed = MixtureDataset([(paper, 2), (drawn, 1)], samples_per_epoch=3000, batch_size=4)
...                                                                                        # doctest: +SKIP

Sample i of epoch e comes from the part that (seed, e, i) draws. If it is the n-th of that part in the epoch,
it is the part's own sample n of epoch e: a data set's samples come in the order of its epoch, each once
before any comes again, whatever the other parts are. What comes again in an epoch, from the same part or from
another variant of it, is augmented anew: all but the first round of the first part by (seed, e, key, i).
"""

from __future__ import annotations

import hashlib
import multiprocessing
from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any, Protocol

import numpy as np

from ocnf_data.arrays import I64
from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.loading.arguments import bad_setting, whole
from ocnf_data.loading.catalogue import check_meaning
from ocnf_data.loading.drawn import DrawnDataset
from ocnf_data.loading.fetch import RawSample
from ocnf_data.loading.supply import Supply
from ocnf_data.shards.tarformat import JSON

MIXED_VARIANT = "mixture"
"""What stands in the inputs' member names for the parts' variants: a network is not told which it gets."""


class _HasSupply(Protocol):
    def supply(self) -> Supply: ...


class MixtureDataset(DrawnDataset):
    """Batches out of several data sets with weights.

    The parts' own batch sizes, ranks, augmentation and handling of errors do not count.

    Args:
        parts: (data set, weight) of each: a `ShardDataset` (of one variant of its inputs) or a
            `SynthesisDataset`, all of the same resolutions and encoding; the weights are relative.
        samples_per_epoch: how many samples make an epoch, of all ranks together.
        seed: seed of the choice among the parts, and of the augmentation.
        batch_size: samples a batch, for each rank.
        rank: number of this process, from 0, or None, with the same meaning as for `ShardDataset`.
        world_size: number of processes that train together, or None.
        on_error: "raise", or "skip" for the part's next sample in the place of one that is damaged or cannot
            be made; or a list with one of them for each part.
        uneven: "repeat" or "exact", as for `ShardDataset`.
        drop_last: leave out the last, incomplete round of batches.
        augment: "none", "rotations", "flips" or "all".
        max_bad_fraction: with on_error="skip", the share of the samples that this rank meets in an epoch (and
            at least one) that may be replaced before the run stops.

    Raises:
        OcnfError: no parts, a weight that is not positive, parts that do not go together.
    """

    def __init__(
        self,
        parts: Sequence[tuple[_HasSupply, float]],
        samples_per_epoch: int,
        *,
        seed: int = 0,
        batch_size: int = 1,
        rank: int | None = None,
        world_size: int | None = None,
        on_error: str | Sequence[str] = "raise",
        uneven: str = "repeat",
        drop_last: bool = False,
        augment: str = "none",
        max_bad_fraction: float = 0.05,
    ) -> None:
        for i, one in enumerate(parts):
            if not isinstance(one, tuple | list) or len(one) != 2 or not hasattr(one[0], "supply"):
                raise OcnfError("not a part", where="MixtureDataset", field=f"parts[{i}]",
                                found=type(one).__name__, expected="(data set, weight)")
        supplies = [(dataset.supply(), weight) for dataset, weight in parts]
        policies = [on_error] * len(supplies) if isinstance(on_error, str) else on_error
        if not isinstance(policies, Sequence) or len(policies) != len(supplies):
            raise bad_setting("neither one for all parts nor one for each", "on_error", on_error,
                              f'"raise", "skip" or a list of {len(supplies)} of them', "MixtureDataset")
        n_samples = whole("samples_per_epoch", samples_per_epoch, least=1, where="MixtureDataset")
        self._mixed = MixtureSupply(supplies, whole("seed", seed, least=0, where="MixtureDataset"))
        super().__init__(self._mixed, n_samples, seed=seed, batch_size=batch_size, rank=rank,
                         world_size=world_size, on_error=policies, uneven=uneven, drop_last=drop_last,
                         augment=augment, max_bad_fraction=max_bad_fraction)

    def _order(self) -> dict[str, Any]:
        told = {"showings": "apart"} if self._mixed.apart else {}
        return {"mixture": self.checksum, "parts": self._mixed.order[1:], **told, **self._drawn_order()}

    def as_before(self) -> MixtureDataset:
        """This data set, but a sample that comes again is augmented alike, as in earlier versions."""
        self._mixed.apart = False
        return self

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """As of every loader; a state of an earlier version goes on with samples that come again alike."""
        ours = self._mixed.apart
        if isinstance(state, Mapping) and state.get("mixture") in self._mixed.checksums_before:
            state = {**state, "mixture": self.checksum}
        self._mixed.apart = not isinstance(state, Mapping) or "showings" in state
        try:
            super().load_state_dict(state)
        except OcnfError:
            self._mixed.apart = ours
            raise


class MixtureSupply:
    """Samples of several supplies; see `loading.supply.Supply`.

    Args:
        parts: (supply, weight) of each.
        seed: seed of the choice among the parts.
    """

    def __init__(self, parts: Sequence[tuple[Supply, float]], seed: int) -> None:
        _check(parts)
        self._supplies = [supply for supply, _ in parts]
        self._ends = np.cumsum([float(weight) for _, weight in parts])
        self._seed = seed
        # Of a spawn context, which works under fork too: workers that run already see a state that is loaded.
        self._apart = multiprocessing.get_context("spawn").RawValue("b", True)
        self._epoch = -1
        self._places = np.empty((0, 2), np.int64)
        self.request = replace(self._supplies[0].request, variant=MIXED_VARIANT)
        given = [weight for _, weight in parts]
        self.checksum = self._checksum([float(weight) for weight in given])
        self.checksums_before = tuple(self._checksum(weights) for weights in (
            [weight if isinstance(weight, int) else float(weight) for weight in given],
            [int(weight) if float(weight).is_integer() else float(weight) for weight in given]))
        """What earlier versions gave the same mixture: to them a weight of 1 was another than one of 1.0."""

    def _checksum(self, weights: Sequence[float]) -> str:
        return sha256_hex(canonical_json([
            [supply.checksum, supply.request.variant, supply.request.split, supply.request.categories, weight]
            for supply, weight in zip(self._supplies, weights, strict=True)]))

    @property
    def apart(self) -> bool:
        """Whether samples that come again in an epoch are told apart from their first showing."""
        return bool(self._apart.value)

    @apart.setter
    def apart(self, value: bool) -> None:
        self._apart.value = value

    @property
    def order(self) -> list[Any]:
        """What the order of samples depends on beside them: the seed, and the same of each part."""
        return [self._seed, *(supply.order for supply in self._supplies)]

    @property
    def manifest(self) -> dict[str, Any]:
        """The manifest of the first part; the others agree where it matters."""
        return self._supplies[0].manifest

    def key(self, epoch: int, number: int, attempt: int) -> str:
        """The key of the part's sample."""
        part, n = self.place(epoch, number)
        return self._supplies[part].key(epoch, n, attempt)

    def part(self, epoch: int, number: int) -> int:
        """Which part a sample is of."""
        return self.place(epoch, number)[0]

    def sample(self, epoch: int, number: int, attempt: int) -> RawSample:
        """The part's sample, its inputs under the mixture's name."""
        part, n = self.place(epoch, number)
        supply = self._supplies[part]
        sample = supply.sample(epoch, n, attempt)
        names = zip(supply.request.members(), self.request.members(), strict=True)
        showing = f" {number}" if self.apart and (part or sample.showing) else ""
        return replace(sample, showing=showing, octrees={
            ours: sample.octrees[theirs] for theirs, ours in names if theirs != JSON})

    def place(self, epoch: int, number: int) -> tuple[int, int]:
        """Which part a sample is of, and its number there."""
        if epoch != self._epoch:
            self._epoch, self._places = epoch, np.empty((0, 2), np.int64)
        if number >= len(self._places):
            self._places = self._draw(epoch, max(1024, 2 * (number + 1)))
        part, n = self._places[number].tolist()
        return part, n

    def _draw(self, epoch: int, n: int) -> I64:
        """(n, 2): part and number in it of the first n samples of an epoch."""
        key = hashlib.sha256(f"ocnf mixture {self._seed} {epoch}".encode()).digest()[:16]
        # Words of a bit generator, as in `loading.order`: their stream is promised to stay.
        words = np.random.Philox(key=int.from_bytes(key, "little")).random_raw(n) >> np.uint64(11)
        at = words.astype(np.float64) / 2**53 * self._ends[-1]
        part = np.minimum(np.searchsorted(self._ends, at, side="right"), len(self._ends) - 1)
        places = np.empty((n, 2), np.int64)
        places[:, 0] = part
        for p in range(len(self._ends)):
            mine = part == p
            places[mine, 1] = np.arange(mine.sum())
        return places


def _is_weight(weight: object) -> bool:
    try:
        return not isinstance(weight, bool) and isinstance(weight, Real) and 0 < float(weight) < float("inf")
    except OverflowError:  # an integer beyond all floats
        return False


def _check(parts: Sequence[tuple[Supply, float]]) -> None:
    """Refuse what cannot be mixed."""
    if not parts:
        raise OcnfError("there is nothing to mix", code="empty", where="MixtureDataset", field="parts")
    first = parts[0][0]
    for i, (supply, weight) in enumerate(parts):
        if not _is_weight(weight):
            raise OcnfError("not a weight", where="MixtureDataset", field=f"parts[{i}]", found=repr(weight),
                            expected="a number above 0")
        for field in ("resolutions", "encoding", "targets"):
            mine, theirs = getattr(supply.request, field), getattr(first.request, field)
            if mine != theirs:
                raise OcnfError("the parts do not go together", where=f"MixtureDataset, part {i}",
                                field=field, found=mine, expected=f"{theirs}, as in part 0")
        check_meaning(f"part {i}", supply.manifest, "part 0", first.manifest)
