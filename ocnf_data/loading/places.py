"""Where the members of a sample lie: read from a shard's index when its first sample is fetched.

What an index says of the members that were asked for is kept as arrays, 48 bytes a member, for as many shards
as fit into some 25 MB: the shards that a window of the shuffled order spans, many times over.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from ocnf_data.arrays import I64, U8
from ocnf_data.errors import OcnfError
from ocnf_data.loading.catalogue import Catalogue
from ocnf_data.shards.index import Member, SampleEntry, index_path
from ocnf_data.shards.index_files import load_index

_KEPT_MEMBERS = 2**19


@dataclass(frozen=True, eq=False)
class Places:
    """M members of each of n samples of one shard, in the order of the request.

    Attributes:
        offsets, sizes: (n, M) int64, bytes in the tar, of the payloads.
        digests: (n, M, 32) uint8, SHA-256 of the payloads.
    """

    offsets: I64
    sizes: I64
    digests: U8

    @classmethod
    def of(cls, samples: Sequence[SampleEntry], names: Sequence[str]) -> Self:
        """The places of members, by name, of samples that have them all."""
        members = [{member.name: member for member in sample.members} for sample in samples]
        found = [of_sample[name] for of_sample in members for name in names]
        shape = len(samples), len(names)
        digests = bytes.fromhex("".join(member.sha256 for member in found))
        return cls(np.array([member.offset for member in found], np.int64).reshape(shape),
                   np.array([member.size for member in found], np.int64).reshape(shape),
                   np.frombuffer(digests, np.uint8).reshape(*shape, 32))

    def members(self, row: int, names: Sequence[str]) -> list[Member]:
        """The members of a sample as the index has them."""
        return [Member(name=name, offset=int(offset), size=int(size), sha256=digest.tobytes().hex())
                for name, offset, size, digest in zip(names, self.offsets[row], self.sizes[row],
                                                      self.digests[row], strict=True)]


class PlaceFinder:
    """Looks up the members of the samples of a catalogue; keeps what it last needed."""

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue
        self._names = catalogue.request.members()
        self._wanted = set(self._names)
        self._first: I64 = np.cumsum(catalogue.shard_sizes) - catalogue.shard_sizes
        self._kept: OrderedDict[int, Places] = OrderedDict()
        self._n_kept = 0

    def members(self, sample: int) -> list[Member]:
        """The members of a sample that were asked for.

        Raises:
            OcnfError: its shard's index is damaged, or (code `catalogue`) says other things than the
                catalogue.
        """
        shard = int(self._catalogue.shard_of[sample])
        places = self._kept.get(shard)
        if places is None:
            places = self._kept[shard] = self._read(shard)
            self._n_kept += places.offsets.size
            while self._n_kept > _KEPT_MEMBERS and len(self._kept) > 1:
                self._n_kept -= self._kept.popitem(last=False)[1].offsets.size
        self._kept.move_to_end(shard)
        return places.members(sample - int(self._first[shard]), self._names)

    def _read(self, shard: int) -> Places:
        catalogue, shards, split = self._catalogue, self._catalogue.shards, self._catalogue.request.split
        index = load_index(shards.store(shard), split, shards.entry(shard))
        first = int(self._first[shard])
        entries = []
        for sample in range(first, first + int(catalogue.shard_sizes[shard])):
            found = index.samples[catalogue.position[sample]]
            key, names = catalogue.keys[sample], {member.name for member in found.members}
            if (found.key, found.category) != (key, catalogue.category(sample)) or not names >= self._wanted:
                raise OcnfError("the index says other things of a sample than the catalogue",
                                code="catalogue", field=key,
                                where=shards.store(shard).where(index_path(split, index.shard)),
                                fix="`ocnf-data repair` makes the catalogue again from the indices")
            entries.append(found)
        return Places.of(entries, self._names)
