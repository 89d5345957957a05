"""Which samples were asked for, and where each of their members lies.

Samples are numbered 0 .. N-1: data sets in the order given, their shards as in `dataset.json`, the samples in
the order of the tar. What the indices say is kept as a few arrays, for the members that were asked for alone:
a few hundred bytes a sample, cheap to send to workers, and shared by forked ones.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ocnf_data.arrays import I32, I64, U8, Bool
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.octree.stored import TARGET
from ocnf_data.shards.dataset import DatasetInfo, ShardEntry, load_dataset
from ocnf_data.shards.index import Member, ShardIndex, shard_path
from ocnf_data.shards.reader import load_index
from ocnf_data.shards.tarformat import JSON, input_member, parse_member, target_member

_READERS = 8  # indices read at a time: over a network it is the latency that counts


@dataclass(frozen=True)
class Request:
    """What is wanted of every sample.

    Attributes:
        split: `train`, `val`, `test`, ...
        resolutions: voxels a side, each once.
        encoding: of the inputs; None for no inputs.
        variant: of the inputs; None for the only one that there is.
        categories: None for all.
        targets: whether the ground truth is wanted.
    """

    split: str
    resolutions: tuple[int, ...]
    encoding: Encoding | None
    variant: str | None
    categories: tuple[str, ...] | None
    targets: bool

    def inputs(self) -> list[str]:
        """Member names of the inputs, by resolution."""
        if self.encoding is None or self.variant is None:
            return []
        return [input_member(self.variant, self.encoding, resolution) for resolution in self.resolutions]

    def ground_truth(self) -> list[str]:
        """Member names of the targets, by resolution."""
        return [target_member(resolution) for resolution in self.resolutions] if self.targets else []

    def members(self) -> list[str]:
        """All members to be read, `json` first."""
        return [JSON, *self.inputs(), *self.ground_truth()]


@dataclass(frozen=True)
class Shard:
    """A shard that has samples: the data set's URL, the tar's name in it, and its size in bytes."""

    url: str
    name: str
    size: int


@dataclass(frozen=True, eq=False)
class Catalogue:
    """The N samples; M members of each, in the order of `request.members()`.

    Attributes:
        request: with the variant filled in.
        datasets: checksum of each `dataset.json`, in the order given.
        manifest: of the first data set; the others agree where it matters.
        shards: those with samples.
        shard_sizes: samples of each.
        shard_of: (N,) int32.
        keys, categories: of each sample.
        offsets, sizes: (N, M) int64, bytes in the tar, of the payloads.
        digests: (N, M, 32) uint8, SHA-256 of the payloads.
        closes: (N,) bool, whether the sample is its tar's last.
    """

    request: Request
    datasets: tuple[str, ...]
    manifest: dict[str, Any]
    shards: tuple[Shard, ...]
    shard_sizes: tuple[int, ...]
    shard_of: I32
    keys: tuple[str, ...]
    categories: tuple[str, ...]
    offsets: I64
    sizes: I64
    digests: U8
    closes: Bool

    def __len__(self) -> int:
        return len(self.keys)

    def members(self, sample: int) -> list[Member]:
        """The members of a sample as the index has them."""
        return [Member(name=name, offset=int(offset), size=int(size), sha256=digest.tobytes().hex())
                for name, offset, size, digest in zip(self.request.members(), self.offsets[sample],
                                                      self.sizes[sample], self.digests[sample], strict=True)]


def open_catalogue(urls: Sequence[str], request: Request) -> Catalogue:
    """Read `dataset.json` and the indices of the split of every data set.

    Raises:
        OcnfError: a data set is unfinished or damaged, lacks what is asked for (the message has what there
            is), differs from the others in what values mean, or no sample is left (`empty`).
    """
    if not urls:
        raise OcnfError("no data set is given", code="empty", where="ShardDataset", field="urls")
    infos = [load_dataset(url) for url in urls]
    _check_agreement(urls, infos)
    shards: list[tuple[str, ShardEntry]] = []
    for url, info in zip(urls, infos, strict=True):
        if request.split not in info.splits:
            raise OcnfError("the data set has no such split", code="missing", where=url, field="split",
                            found=request.split, expected=", ".join(info.splits))
        shards += [(url, entry) for entry in info.splits[request.split]]
    with ThreadPoolExecutor(_READERS) as pool:
        indices = pool.map(lambda shard: load_index(Store(shard[0]), request.split, shard[1]), shards)
        return _collect(request, infos, shards, indices)


def _collect(request: Request, infos: Sequence[DatasetInfo], shards: Sequence[tuple[str, ShardEntry]],
             indices: Iterable[ShardIndex]) -> Catalogue:
    used: list[Shard] = []
    sizes: list[int] = []
    keys: list[str] = []
    categories: list[str] = []
    closes: list[bool] = []
    places: list[tuple[int, int]] = []
    digests: list[bytes] = []
    known: set[str] = set()
    wanted: list[str] = []
    for (url, entry), index in zip(shards, indices, strict=True):
        before = len(keys)
        for sample in index.samples:
            known.add(sample.category)
            if request.categories is not None and sample.category not in request.categories:
                continue
            members = {member.name: member for member in sample.members}
            if not wanted:
                request = _with_variant(request, members, url)
                wanted = request.members()
            for name in wanted:
                if name not in members:
                    raise _lacking(name, members, where=f"{url}/{shard_path(index.split, index.shard)}",
                                   key=sample.key)
                places.append((members[name].offset, members[name].size))
                digests.append(bytes.fromhex(members[name].sha256))
            keys.append(sample.key)
            categories.append(sample.category)
            closes.append(sample is index.samples[-1])
        if len(keys) > before:
            used.append(Shard(url, shard_path(index.split, index.shard), entry.size))
            sizes.append(len(keys) - before)
    if missing := set(request.categories or ()) - known:
        raise OcnfError("no sample is of that category", code="empty", where=f"split {request.split}",
                        field="categories", found=", ".join(sorted(missing)),
                        expected=", ".join(sorted(known)))
    if not keys:
        raise OcnfError("the split has no samples", code="empty", where="ShardDataset", field="split",
                        found=request.split)
    table = np.array(places, np.int64).reshape(len(keys), len(wanted), 2)
    return Catalogue(
        request=request,
        datasets=tuple(info.checksum for info in infos),
        manifest=dict(infos[0].manifest),
        shards=tuple(used),
        shard_sizes=tuple(sizes),
        shard_of=np.repeat(np.arange(len(used), dtype=np.int32), sizes),
        keys=tuple(keys),
        categories=tuple(categories),
        offsets=np.ascontiguousarray(table[..., 0]),
        sizes=np.ascontiguousarray(table[..., 1]),
        digests=np.frombuffer(b"".join(digests), np.uint8).reshape(len(keys), len(wanted), 32),
        closes=np.array(closes, np.bool_),
    )


def _with_variant(request: Request, members: Collection[str], url: str) -> Request:
    """The request with its variant: the one asked for, or the only one of its encoding."""
    if request.encoding is None or request.variant is not None:
        return request
    parsed = [parse_member(name) for name in members if name != JSON]
    found = sorted({variant for variant, encoding, _ in parsed if encoding == request.encoding})
    if not found:
        raise OcnfError("the data set has no input of that encoding", code="missing", where=url,
                        field="encoding", found=str(request.encoding), expected=_what_there_is(members))
    if len(found) > 1:
        raise OcnfError("there are several input variants", code="missing", where=url, field="variant",
                        expected=f"one of {', '.join(found)}", fix="say which with variant=...")
    return replace(request, variant=found[0])


def _lacking(name: str, members: Collection[str], where: str, key: str) -> OcnfError:
    variant, encoding, resolution = parse_member(name)
    parsed = [parse_member(member) for member in members if member != JSON]
    kind = [(v, e) for v, e, _ in parsed]
    field, found = ("resolutions", str(resolution)) if (variant, encoding) in kind else ("variant", name)
    if variant == TARGET and field == "variant":
        field, found = "targets", name
    return OcnfError("the data set has no such octrees", code="missing", where=where, field=f"{key}: {field}",
                     found=found, expected=_what_there_is(members))


def _what_there_is(members: Collection[str]) -> str:
    return ", ".join(sorted(member.removesuffix(".oct") for member in members if member != JSON))


def _check_agreement(urls: Sequence[str], infos: Sequence[DatasetInfo]) -> None:
    """Refuse data sets whose values mean different things."""
    for url, info in zip(urls, infos, strict=True):
        check_meaning(url, info.manifest, urls[0], infos[0].manifest)


def check_meaning(where: str, manifest: Mapping[str, Any], first: str, other: Mapping[str, Any]) -> None:
    """Refuse a data set whose truncation, target or size of the cube are not those of another one.

    Args:
        where: the data set.
        manifest: its resolved manifest.
        first: the other one.
        other: its manifest.

    Raises:
        OcnfError: names the field and both values.
    """
    for field, mine, theirs in zip(("truncation_voxels", "target", "normalise.extent"),
                                   _meaning(manifest), _meaning(other), strict=True):
        if mine != theirs:
            raise OcnfError("the data sets do not go together", where=where, field=field, found=mine,
                            expected=f"{theirs}, as in {first}")


def _meaning(manifest: Mapping[str, Any]) -> tuple[object, object, object]:
    normalise = manifest.get("normalise")
    extent = normalise.get("extent") if isinstance(normalise, dict) else None
    return manifest.get("truncation_voxels"), manifest.get("target"), extent
