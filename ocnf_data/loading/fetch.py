"""Read a sample's checked octrees, given its number: the work that a loader's worker process does.

Reading is by offset, so any order of samples will do, and members that nobody asked for are never touched.
Every check of `shards.reader` is made on every read: header, padding and SHA-256 of each member, the size of
the tar when it is first opened, its last blocks with its last sample. Nothing is kept between samples but
a few open files, and where the members of the shards in use lie.
"""

from __future__ import annotations

import json
import os
from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.loading.catalogue import Catalogue
from ocnf_data.loading.places import PlaceFinder
from ocnf_data.octree.codec import decode_raw
from ocnf_data.octree.stored import TARGET, RawOctree
from ocnf_data.octree.symmetry import Symmetry
from ocnf_data.shards.index import shard_path
from ocnf_data.shards.reader import TarReader
from ocnf_data.shards.tarformat import JSON, parse_member

_OPEN_FILES = 16


@dataclass(frozen=True, eq=False)
class RawSample:
    """A sample as it is stored; `octrees` by member name.

    `showing` is empty, but where a loader may meet the same key before in an epoch: there it is another text
    each time, so that what is drawn for the sample is drawn anew.
    """

    key: str
    category: str
    meta: dict[str, Any]
    octrees: dict[str, RawOctree]
    showing: str = ""

    @property
    def draw(self) -> str:
        """What is drawn for the sample in an epoch is drawn by."""
        return self.key + self.showing

    def moved(self, symmetry: Symmetry) -> RawSample:
        """All octrees under one symmetry; `meta` still speaks of the sample as it was."""
        octrees = {name: symmetry(octree) for name, octree in self.octrees.items()}
        return replace(self, octrees=octrees)


class Fetcher:
    """Reads samples of a catalogue. Picklable and safe to fork: each process opens its own files."""

    def __init__(self, catalogue: Catalogue) -> None:
        self.catalogue = catalogue
        self._places = PlaceFinder(catalogue)
        self._tars: OrderedDict[int, TarReader] = OrderedDict()
        self._process = os.getpid()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_tars": OrderedDict(), "_places": PlaceFinder(self.catalogue)}

    def fetch(self, sample: int) -> RawSample:
        """Read, check and decode a sample.

        Raises:
            OcnfError: names the shard, the key, the member and its byte offset.
        """
        catalogue = self.catalogue
        key = catalogue.keys[sample]
        members = self._places.members(sample)
        tar = self._tar(int(catalogue.shard_of[sample]))
        try:
            payloads = tar.read(key, members, catalogue.closes(sample))
        except OcnfError as error:
            raise error.replaced(where=tar.where, field=error.field or key) from None
        meta: dict[str, Any] = {}
        octrees: dict[str, RawOctree] = {}
        for member, payload in zip(members, payloads, strict=True):
            try:
                if member.name == JSON:
                    meta = _parse_meta(payload)
                else:
                    octrees[member.name] = _decode(member.name, payload)
            except OcnfError as error:
                raise error.replaced(where=tar.where,
                                 field=f"{key}.{member.name} at byte {member.offset}") from None
        return RawSample(key, catalogue.category(sample), meta, octrees)

    def _tar(self, shard: int) -> TarReader:
        if self._process != os.getpid():  # forked: the parent's file positions and sockets are not ours
            self._tars = OrderedDict()
            self._process = os.getpid()
        if shard not in self._tars:
            shards, split = self.catalogue.shards, self.catalogue.request.split
            entry = shards.entry(shard)
            self._tars[shard] = TarReader(shards.store(shard), shard_path(split, entry.shard), entry.size)
            if len(self._tars) > _OPEN_FILES:
                self._tars.popitem(last=False)[1].close()
        self._tars.move_to_end(shard)
        return self._tars[shard]


def _parse_meta(payload: bytes) -> dict[str, Any]:
    try:
        meta = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise OcnfError("not JSON", code="json", found=error) from None
    if not isinstance(meta, dict):
        raise OcnfError("not a JSON object", code="json", found=type(meta).__name__)
    return meta


def _decode(name: str, payload: bytes) -> RawOctree:
    _, encoding, resolution = parse_member(name)
    return decode_raw(payload, TARGET if encoding is None else str(encoding), resolution)
