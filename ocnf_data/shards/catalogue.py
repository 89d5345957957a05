"""The catalogue of a split: its samples in one small file, so that opening it reads no index.

A safetensors file, about 25 bytes a sample:

    8 bytes     uint64, little-endian: bytes of the header
    header      JSON, padded with blanks to a multiple of 8: {"__metadata__": {"ocnf": "..."}, ...}
    samples     (S,) uint32   samples of each shard, in the order of dataset.json
    categories  (N,) uint32   each sample's category: its place in the metadata's list
    members     (N,) uint32   the names of each sample's members: their place in the metadata's list of lists
    keys        (K,) uint8    the keys in ASCII, a newline after each

The one metadata key `ocnf` holds canonical JSON: {"categories": ["chair", ...], "members": [["json", ...],
...], "split": "train", "version": 1}; both lists are in the order of first use. The file is a pure function
of the split's indices. Where a member lies, and what it must hash to, is not in it: that is read from a
shard's index when its first sample is.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np

from ocnf_data.arrays import I64, U8, U32, Bool
from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.files.storage import Store
from ocnf_data.shards.dataset import DatasetInfo
from ocnf_data.shards.index import MAX_MEMBERS, ShardIndex, catalogue_path, check_split
from ocnf_data.shards.index_files import load_indices
from ocnf_data.shards.tarformat import JSON, MAX_KEY, check_member

CATALOGUE_VERSION: Final = 1
MAX_CATALOGUE_BYTES = 2**30
_MAX_TEXT = 1024  # of a category, as in an index
_NEWLINE = 10
_KEY_BYTES = np.zeros(256, np.bool_)
_KEY_BYTES[list(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-\n")] = True
_log = logging.getLogger(__name__)


class Keys:
    """Many keys in one piece of memory: about 8 bytes each more than their letters, and cheap to send.

    Args:
        text: the keys in ASCII, a newline after each.
    """

    def __init__(self, text: bytes) -> None:
        self.text = text
        self._ends: I64 = np.flatnonzero(np.frombuffer(text, np.uint8) == _NEWLINE)

    @classmethod
    def of(cls, keys: Iterable[str]) -> Self:
        """The keys of a sequence."""
        return cls("".join(f"{key}\n" for key in keys).encode("ascii"))

    def __len__(self) -> int:
        return len(self._ends)

    def __getitem__(self, place: int) -> str:
        place = range(len(self))[place]
        start = int(self._ends[place - 1]) + 1 if place else 0
        return self.text[start : int(self._ends[place])].decode("ascii")

    def __iter__(self) -> Iterator[str]:
        return iter(self.text.decode("ascii").split("\n")[:-1])

    def take(self, chosen: Bool) -> Self:
        """The keys that are chosen, (N,) bool."""
        letters = np.frombuffer(self.text, np.uint8)
        return type(self)(letters[np.repeat(chosen, self.lengths() + 1)].tobytes())

    def find(self, key: str) -> int | None:
        """The place of a key; None where it is not there."""
        line = f"{key}\n".encode()
        if self.text.startswith(line):
            return 0
        before = self.text.find(b"\n" + line)
        return None if before < 0 else int(np.searchsorted(self._ends, before)) + 1

    def lengths(self) -> I64:
        """(N,) int64, letters of each key."""
        return np.diff(self._ends, prepend=-1) - 1


@dataclass(frozen=True)
class ShardContents:
    """What a catalogue takes from one index: of each sample its key, its category and its members' names."""

    keys: bytes
    categories: tuple[str, ...]
    members: tuple[tuple[str, ...], ...]

    @classmethod
    def of(cls, index: ShardIndex) -> Self:
        """The contents of a shard; equal texts are one object, here and where they are sent to."""
        known: dict[tuple[str, ...], tuple[str, ...]] = {}
        lists = (tuple(sys.intern(member.name) for member in sample.members) for sample in index.samples)
        return cls(Keys.of(sample.key for sample in index.samples).text,
                   tuple(sys.intern(sample.category) for sample in index.samples),
                   tuple(known.setdefault(names, names) for names in lists))


@dataclass(frozen=True, eq=False)
class SplitCatalogue:
    """The N samples of the S shards of a split.

    Attributes:
        split: name of the split.
        samples: (S,) uint32, samples of each shard.
        keys: keys of all samples, shard by shard.
        categories: each name once, in the order of first use.
        category_of: (N,) uint32, the category's place in that list.
        members: lists of member names, each once, in the order of first use.
        members_of: (N,) uint32, the list's place.
    """

    split: str
    samples: U32
    keys: Keys
    categories: tuple[str, ...]
    category_of: U32
    members: tuple[tuple[str, ...], ...]
    members_of: U32

    @classmethod
    def of(cls, split: str, shards: Iterable[ShardContents]) -> Self:
        """The catalogue of a split, from what its shards hold, in the order of `dataset.json`."""
        samples: list[int] = []
        keys: list[bytes] = []
        categories: dict[str, int] = {}
        lists: dict[tuple[str, ...], int] = {}
        category_of: list[U32] = []
        members_of: list[U32] = []
        for shard in shards:
            samples.append(len(shard.categories))
            keys.append(shard.keys)
            category_of.append(_numbers(shard.categories, categories))
            members_of.append(_numbers(shard.members, lists))
        none = [np.zeros(0, np.uint32)]
        return cls(check_split(split), np.array(samples, np.uint32), Keys(b"".join(keys)), tuple(categories),
                   np.concatenate(category_of or none), tuple(lists), np.concatenate(members_of or none))

    def __len__(self) -> int:
        return len(self.category_of)

    def find(self, key: str) -> tuple[int, int] | None:
        """(place of the shard, number in it) of a sample; None where the split has none of that key."""
        place = self.keys.find(key)
        if place is None:
            return None
        ends = np.cumsum(self.samples, dtype=np.int64)
        shard = int(np.searchsorted(ends, place, side="right"))
        return shard, place - int(ends[shard] - self.samples[shard])

    def to_bytes(self) -> bytes:
        """The file; equal catalogues give equal bytes."""
        header = _header(self.split, self.categories, self.members, len(self.samples), len(self),
                         len(self.keys.text))
        arrays = (self.samples, self.category_of, self.members_of)
        return b"".join((len(header).to_bytes(8, "little"), header,
                         *(array.astype("<u4", copy=False).tobytes() for array in arrays), self.keys.text))

    @classmethod
    def from_bytes(cls, blob: bytes, where: object) -> Self:
        """Inverse of `to_bytes`; any bytes are safe.

        Raises:
            OcnfError: code `catalogue`; the bytes are not exactly what `to_bytes` gives for some catalogue.
        """
        try:
            return cls._parsed(blob)
        except (OcnfError, ValueError, TypeError, LookupError, RecursionError) as error:
            what = error.what if isinstance(error, OcnfError) else str(error)
            raise OcnfError(f"not a catalogue: {what}", code="catalogue", where=where) from None

    @classmethod
    def _parsed(cls, blob: bytes) -> Self:
        length = int.from_bytes(blob[:8], "little")
        text = blob[8 : 8 + length]
        if len(blob) < 8 or len(text) < length:
            raise ValueError("cut off in the header")
        header = json.loads(text)
        meta = json.loads(header["__metadata__"]["ocnf"])
        split, categories, members = meta["split"], tuple(meta["categories"]), _lists(meta["members"])
        if not all(isinstance(name, str) and len(name) <= _MAX_TEXT for name in categories):
            raise ValueError("a category is no short text")
        n_shards, n_samples, n_text = (header[name]["shape"][0] for name in ("samples", "categories", "keys"))
        if text != _header(split, categories, members, n_shards, n_samples, n_text):
            raise ValueError("the header is not the canonical one")
        if len(blob) != 8 + length + 4 * (n_shards + 2 * n_samples) + n_text:
            raise ValueError("the file is not of the size that its header claims")
        arrays, start = [], 8 + length
        for count in (n_shards, n_samples, n_samples):
            arrays.append(np.frombuffer(blob, "<u4", count, start).astype(np.uint32))
            start += 4 * count
        keys = Keys(blob[start:])
        letters: U8 = np.frombuffer(keys.text, np.uint8)
        lengths = keys.lengths()
        if not (_KEY_BYTES[letters].all() and len(keys) == n_samples and keys.text[-1:] in (b"", b"\n")):
            raise ValueError("the keys are not one short name of A-Z a-z 0-9 _ - a sample")
        if n_samples and not 1 <= lengths.min() <= lengths.max() <= MAX_KEY:
            raise ValueError("a key is empty or too long")
        if int(arrays[0].sum(dtype=np.int64)) != n_samples:
            raise ValueError("the shards' samples are not as many as the split's")
        if not (_in_order_of_use(arrays[1], len(set(categories)), len(categories))
                and _in_order_of_use(arrays[2], len(set(members)), len(members))):
            raise ValueError("a list is not in the order of first use")
        return cls(check_split(split), arrays[0], keys, categories, arrays[1], members, arrays[2])


def load_catalogue(store: Store, info: DatasetInfo, split: str) -> SplitCatalogue:
    """The catalogue of a split of a data set.

    A lost one, and that of a data set made before there were any, is made again from the indices in memory.

    Args:
        store: the data set's folder.
        info: `dataset.json` of the data set.
        split: one of `info.splits`.

    Raises:
        OcnfError: code `checksum` for a damaged catalogue, or what `load_index` raises.
    """
    stored = stored_catalogue(store, info, split)
    return made_catalogue(store, info, split) if stored is None else stored


def stored_catalogue(store: Store, info: DatasetInfo, split: str) -> SplitCatalogue | None:
    """The catalogue that `dataset.json` lists; None where it lists none, or the file is lost.

    Raises:
        OcnfError: code `checksum` for a damaged catalogue, `catalogue` for one that is none, or is one of
            other shards.
    """
    name = catalogue_path(split)
    entry = info.file(name)
    if entry is None:
        return None
    where = store.where(name)
    if entry.size > MAX_CATALOGUE_BYTES:
        raise OcnfError("the catalogue is too large", code="too_large", where=where, found=entry.size,
                        expected=f"at most {MAX_CATALOGUE_BYTES} bytes")
    try:
        blob = store.read_at_most(name, entry.size)
    except OcnfError as error:
        if error.code == "missing":
            _log.warning("%s is lost: %d indices are read instead; `ocnf-data repair` makes it again", where,
                         len(info.splits[split]))
            return None
        if error.code != "too_large":
            raise
        blob = b""
    if sha256_hex(blob) != entry.sha256:
        raise OcnfError("the catalogue is not the file that dataset.json lists", code="checksum", where=where,
                        fix="`ocnf-data repair` makes it again from the indices")
    catalogue = SplitCatalogue.from_bytes(blob, where)
    shards = [shard.samples for shard in info.splits[split]]
    if catalogue.split != split or catalogue.samples.tolist() != shards:
        raise OcnfError("a catalogue of other shards", code="catalogue", where=where,
                        fix="`ocnf-data repair` makes it again from the indices")
    return catalogue


def made_catalogue(store: Store, info: DatasetInfo, split: str) -> SplitCatalogue:
    """The catalogue of a split, from its indices."""
    indices = load_indices(store, ((split, entry) for entry in info.splits[split]))
    return SplitCatalogue.of(split, (ShardContents.of(index) for index in indices))


def _numbers(values: Sequence[Any], known: dict[Any, int]) -> U32:
    """The place of each value among those known; new ones are added."""
    return np.fromiter((known.setdefault(value, len(known)) for value in values), np.uint32, len(values))


def _lists(raw: list[list[str]]) -> tuple[tuple[str, ...], ...]:
    """Lists of member names, if samples may have them."""
    lists = tuple(tuple(check_member(name) for name in names) for names in raw)
    if any(not 1 <= len(names) <= MAX_MEMBERS or names[0] != JSON for names in lists):
        raise ValueError("a list of members is empty, too long or does not begin with json")
    return lists


def _in_order_of_use(numbers: U32, n_distinct: int, n_listed: int) -> bool:
    """Whether each new number is the one after the largest before, and every place of the list is used."""
    if not len(numbers):
        return n_listed == 0
    largest = np.maximum.accumulate(numbers.astype(np.int64))
    in_order = largest[0] == 0 and (np.diff(largest) <= 1).all()
    return bool(in_order and largest[-1] + 1 == n_distinct == n_listed)


def _header(split: str, categories: Sequence[str], members: Sequence[Sequence[str]], n_shards: int,
            n_samples: int, n_text: int) -> bytes:
    """The safetensors header, padded."""
    tensors: dict[str, Any] = {}
    start = 0
    for name, dtype, width, count in (("samples", "U32", 4, n_shards), ("categories", "U32", 4, n_samples),
                                      ("members", "U32", 4, n_samples), ("keys", "U8", 1, n_text)):
        if type(count) is not int or not 0 <= count <= MAX_CATALOGUE_BYTES:
            raise ValueError("not a number of entries")
        tensors[name] = {"dtype": dtype, "shape": [count], "data_offsets": [start, start + width * count]}
        start += width * count
    meta = {"categories": list(categories), "members": [list(names) for names in members], "split": split,
            "version": CATALOGUE_VERSION}
    metadata = {"ocnf": canonical_json(meta)[:-1].decode("ascii")}
    text = canonical_json({"__metadata__": metadata, **tensors})[:-1]
    return text + b" " * (-len(text) % 8)
