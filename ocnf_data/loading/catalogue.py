"""Which samples were asked for, and which shard each of them lies in.

Samples are numbered 0 .. N-1: data sets in the order given, their shards as in `dataset.json`, the samples
in the order of the tar. All of it comes from the data sets' catalogues (`shards.catalogue`), and is kept as a
few arrays and one text: some 50 bytes a sample, cheap to send to workers, and shared by forked ones. Where a
sample's members lie is looked up when it is fetched (`loading.places`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ocnf_data.arrays import I32, I64, U8, U32, Bool
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.octree.stored import TARGET
from ocnf_data.shards.catalogue import Keys, SplitCatalogue, load_catalogue
from ocnf_data.shards.dataset import DatasetInfo, ShardEntry, load_dataset
from ocnf_data.shards.index import shard_name, shard_path
from ocnf_data.shards.tarformat import JSON, input_member, parse_member, target_member


@dataclass(frozen=True)
class Request:
    """What is wanted of every sample.

    Attributes:
        split: `train`, `val`, `test`, ...
        resolutions: voxels along each axis, each once.
        encoding: encoding of the inputs; None for no inputs.
        variant: variant of the inputs; None for the only one that there is.
        categories: None for all.
        targets: those of the resolutions that the ground truth is wanted at.
    """

    split: str
    resolutions: tuple[int, ...]
    encoding: Encoding | None
    variant: str | None
    categories: tuple[str, ...] | None
    targets: tuple[int, ...]

    def inputs(self) -> list[str]:
        """Member names of the inputs, by resolution."""
        if self.encoding is None or self.variant is None:
            return []
        return [input_member(self.variant, self.encoding, resolution) for resolution in self.resolutions]

    def ground_truth(self) -> list[str]:
        """Member names of the targets, by resolution."""
        return [target_member(resolution) for resolution in self.targets]

    def members(self) -> list[str]:
        """All members to be read, `json` first."""
        return [JSON, *self.inputs(), *self.ground_truth()]


@dataclass(frozen=True, eq=False)
class ShardTable:
    """The S shards that have samples, as arrays: a million samples are some 60,000 shards.

    Attributes:
        urls: URLs of the data sets.
        url_of: (S,) int32, which of them a shard belongs to.
        numbers: (S,) int32, 7 for `shard-000007.tar`.
        sizes: (S,) int64, bytes of the tar.
        samples: (S,) int64, all that the tar holds, asked for or not.
        digests: (S, 2, 32) uint8, SHA-256 of the tar and of its index.
    """

    urls: tuple[str, ...]
    url_of: I32
    numbers: I32
    sizes: I64
    samples: I64
    digests: U8

    @classmethod
    def of(cls, shards: Sequence[tuple[int, ShardEntry]], urls: Sequence[str]) -> ShardTable:
        """The table of (data set, shard) pairs."""
        entries = [entry for _, entry in shards]
        digests = bytes.fromhex("".join(entry.sha256 + entry.index_sha256 for entry in entries))
        return cls(
            tuple(urls),
            np.array([url for url, _ in shards], np.int32),
            np.array([int(entry.shard[len("shard-") : -len(".tar")]) for entry in entries], np.int32),
            np.array([entry.size for entry in entries], np.int64),
            np.array([entry.samples for entry in entries], np.int64),
            np.frombuffer(digests, np.uint8).reshape(-1, 2, 32))

    def __len__(self) -> int:
        return len(self.numbers)

    def store(self, shard: int) -> Store:
        """The data set that a shard belongs to."""
        return Store(self.urls[self.url_of[shard]])

    def entry(self, shard: int) -> ShardEntry:
        """What `dataset.json` says of a shard."""
        tar, index = (digest.tobytes().hex() for digest in self.digests[shard])
        return ShardEntry(shard=shard_name(int(self.numbers[shard])), size=int(self.sizes[shard]), sha256=tar,
                          index_sha256=index, samples=int(self.samples[shard]))


@dataclass(frozen=True, eq=False)
class Catalogue:
    """The N samples.

    Attributes:
        request: what was asked for, with the variant filled in.
        datasets: identity of each data set, in the order given.
        manifest: manifest of the first data set; the others agree where it matters.
        shards: the shards that have samples.
        shard_sizes: (S,) int64, how many of the samples lie in each.
        shard_of: (N,) int32, ascending.
        position: (N,) int32, a sample's number in its tar.
        keys: key of each sample.
        categories: names, each once.
        category_of: (N,) uint32, a sample's place among them.
    """

    request: Request
    datasets: tuple[str, ...]
    manifest: dict[str, Any]
    shards: ShardTable
    shard_sizes: I64
    shard_of: I32
    position: I32
    keys: Keys
    categories: tuple[str, ...]
    category_of: U32

    def __len__(self) -> int:
        return len(self.keys)

    def category(self, sample: int) -> str:
        """A sample's category."""
        return self.categories[self.category_of[sample]]

    def closes(self, sample: int) -> bool:
        """Whether a sample is its tar's last."""
        return bool(self.position[sample] == self.shards.samples[self.shard_of[sample]] - 1)


def open_catalogue(urls: Sequence[str], request: Request) -> Catalogue:
    """Read `dataset.json` and the split's catalogue of every data set.

    Raises:
        OcnfError: a data set is unfinished or damaged, lacks what is asked for (the message has what there
            is), differs from the others in what values mean, or no sample is left (`empty`).
    """
    if not urls:
        raise OcnfError("no data set is given", code="empty", where="ShardDataset", field="urls")
    infos = [load_dataset(url) for url in urls]
    for i, info in enumerate(infos):
        same = next(j for j, other in enumerate(infos) if other.checksum == info.checksum)
        if same < i:
            raise OcnfError("a data set is given twice, and each of its samples would count twice",
                            where="ShardDataset", field="urls", found=f"{urls[same]} and {urls[i]}",
                            expected="each once", fix="to draw from one more often, give it a weight in a "
                            "MixtureDataset")
    _check_agreement(urls, infos)
    for url, info in zip(urls, infos, strict=True):
        if request.split not in info.splits:
            raise OcnfError("the data set has no such split", code="missing", where=url, field="split",
                            found=request.split, expected=", ".join(info.splits))
    shards: list[tuple[int, ShardEntry]] = []
    sizes: list[I64] = []
    positions: list[I32] = []
    keys: list[bytes] = []
    category_of: list[U32] = []
    categories: dict[str, int] = {}
    known: set[str] = set()
    for number, (url, info) in enumerate(zip(urls, infos, strict=True)):
        split = load_catalogue(Store(url), info, request.split)
        entries = info.splits[request.split]
        known.update(split.categories)
        chosen = _chosen(split, request.categories)
        shard_of = np.repeat(np.arange(len(entries)), split.samples)[chosen]
        request = _check_members(request, split, chosen, url, entries, shard_of)
        first = np.cumsum(split.samples, dtype=np.int64) - split.samples
        count = np.bincount(shard_of, minlength=len(entries))
        shards += [(number, entry) for entry, n in zip(entries, count.tolist(), strict=True) if n]
        sizes.append(count[count > 0])
        positions.append((np.flatnonzero(chosen) - first[shard_of]).astype(np.int32))
        keys.append(split.keys.text if chosen.all() else split.keys.take(chosen).text)
        places = [categories.setdefault(name, len(categories)) for name in split.categories]
        category_of.append(np.array(places, np.uint32)[split.category_of[chosen]])
    if missing := set(request.categories or ()) - known:
        raise OcnfError("no sample is of that category", code="empty", where=f"split {request.split}",
                        field="categories", found=", ".join(sorted(missing)),
                        expected=", ".join(sorted(known)))
    if not any(keys):
        raise OcnfError("the split has no samples", code="empty", where="ShardDataset", field="split",
                        found=request.split)
    shard_sizes = np.concatenate(sizes)
    return Catalogue(
        request=request,
        datasets=tuple(info.identity for info in infos),
        manifest=dict(infos[0].manifest),
        shards=ShardTable.of(shards, urls),
        shard_sizes=shard_sizes,
        shard_of=np.repeat(np.arange(len(shards), dtype=np.int32), shard_sizes),
        position=np.concatenate(positions),
        keys=Keys(b"".join(keys)),
        categories=tuple(categories),
        category_of=np.concatenate(category_of),
    )


def _chosen(split: SplitCatalogue, categories: Sequence[str] | None) -> Bool:
    """(N,) bool, whether a sample is of one of the categories; None is all."""
    if categories is None:
        return np.ones(len(split), np.bool_)
    wanted = np.array([name in categories for name in split.categories], np.bool_)
    return wanted[split.category_of]


def _check_members(request: Request, split: SplitCatalogue, chosen: Bool, url: str,
                   entries: Sequence[ShardEntry], shard_of: I64) -> Request:
    """The request with its variant, if every chosen sample has all members that are asked for."""
    lists = split.members_of[chosen]
    if not len(lists):
        return request
    request = _with_variant(request, split.members[lists[0]], url)
    wanted = request.members()
    lacking = np.array([not set(wanted) <= set(names) for names in split.members], np.bool_)[lists]
    if lacking.any():
        first = int(lacking.argmax())
        members = split.members[lists[first]]
        name = next(name for name in wanted if name not in members)
        where = f"{url}/{shard_path(split.split, entries[shard_of[first]].shard)}"
        raise _lacking(name, members, where, key=split.keys[int(np.flatnonzero(chosen)[first])])
    return request


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
                        expected=f"one of {', '.join(found)}",
                        fix="say which with variant=..., of a command with --variant")
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
        manifest: resolved manifest of the data set.
        first: the other data set.
        other: resolved manifest of the other data set.

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
