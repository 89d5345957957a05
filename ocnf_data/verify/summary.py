"""What is in a data set, from `dataset.json` and the indices alone: no tar is read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.shards.dataset import DATASET, DatasetInfo, load_dataset
from ocnf_data.shards.index import ShardIndex, index_path, is_shard
from ocnf_data.shards.index_files import load_indices, read_index
from ocnf_data.shards.tarformat import JSON, parse_member


@dataclass
class SplitSummary:
    """One split: its shards, and its samples by category."""

    shards: int = 0
    size: int = 0
    categories: Counter[str] = field(default_factory=Counter)


@dataclass
class MemberSummary:
    """All members of one name: bytes, and leaves where they are octrees."""

    name: str
    count: int = 0
    size: int = 0
    leaves: int = 0
    fewest: int = 0
    most: int = 0

    @property
    def mean_leaves(self) -> float:
        """Leaves of an octree, on average."""
        return self.leaves / self.count

    @property
    def fill(self) -> float:
        """Leaves as a share of the voxels, on average."""
        return self.mean_leaves / parse_member(self.name)[2] ** 3


@dataclass
class DatasetSummary:
    """A data set at a glance; `info` is None where it is unfinished, and then only finished shards count."""

    url: str
    info: DatasetInfo | None
    splits: dict[str, SplitSummary] = field(default_factory=dict)
    members: dict[str, MemberSummary] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        """Samples in all splits."""
        return sum(split.categories.total() for split in self.splits.values())

    @property
    def size(self) -> int:
        """Bytes of all shards."""
        return sum(split.size for split in self.splits.values())


def describe(url: str | Store) -> DatasetSummary:
    """Sum up a data set, finished or not.

    Raises:
        OcnfError: there is nothing of a data set in the folder, or a file that is read is damaged.
    """
    store = url if isinstance(url, Store) else Store(url)
    info = load_dataset(store) if store.exists(DATASET) else None
    summary = DatasetSummary(store.url, info)
    if info is not None:
        indices = load_indices(store, info.shards())
    else:
        names = store.list()
        shards = [(split, shard) for split, _, shard in
                  (name.partition("/") for name in names if is_shard(name))]
        there = set(names)
        indices = (read_index(store, split, shard) for split, shard in shards
                   if index_path(split, shard) in there)
        if not shards:
            raise OcnfError("no data set here", code="missing", where=store.url,
                            expected=f"a folder with {DATASET} or shards in it")
    for index in indices:
        _add(summary, index)
    return summary


def _add(summary: DatasetSummary, index: ShardIndex) -> None:
    split = summary.splits.setdefault(index.split, SplitSummary())
    split.shards += 1
    split.size += index.size
    for sample in index.samples:
        split.categories[sample.category] += 1
        for member in sample.members:
            part = summary.members.setdefault(member.name, MemberSummary(member.name))
            part.count += 1
            part.size += member.size
            if member.name != JSON:
                leaves = sample.leaf_counts[member.name]
                part.leaves += leaves
                part.fewest = min(part.fewest or leaves, leaves)
                part.most = max(part.most, leaves)


def print_summary(summary: DatasetSummary, console: Console) -> None:
    """Show a summary: what it is, its splits, its members."""
    info = summary.info
    if info is None:
        console.print(f"{escape(summary.url)}: [yellow]unfinished[/], no {DATASET} yet", highlight=False)
    else:
        counts = info.counts
        console.print(f"[bold]{escape(info.name)}[/]  schema {info.schema_version}  {escape(summary.url)}\n"
                      f"{counts.items} inputs = {counts.samples} samples + {counts.failures} failures + "
                      f"{counts.exclusions} exclusions", highlight=False, soft_wrap=True)
        for line in fingerprint_lines(info.fingerprint):
            console.print(line, highlight=False, markup=False)
    console.print(f"{summary.samples} samples, {summary.size / 1e6:.1f} MB", highlight=False)
    splits = Table(*(Column(title, no_wrap=True) for title in ("split", "shards", "samples", "MB")),
                   Column("categories", overflow="fold"), box=None, pad_edge=False)
    for name, split in summary.splits.items():
        categories = ", ".join(f"{category} {n}" for category, n in sorted(split.categories.items()))
        splits.add_row(name, str(split.shards), str(split.categories.total()), f"{split.size / 1e6:.1f}",
                       escape(categories))
    figures = ("count", "MB", "kB\neach", "leaves,\nmean", "fewest", "most", "% of\nvoxels")
    # Names are folded where the terminal is narrow; figures never are.
    members = Table(Column("member", overflow="fold"),
                    *(Column(title, justify="right", no_wrap=True) for title in figures),
                    box=None, pad_edge=False)
    for part in sorted(summary.members.values(), key=_by_kind):
        cells = [part.name, str(part.count), f"{part.size / 1e6:.1f}", f"{part.size / part.count / 1e3:.1f}"]
        if part.name != JSON:
            cells += [f"{part.mean_leaves:.0f}", str(part.fewest), str(part.most), f"{100 * part.fill:.1f}"]
        members.add_row(*cells)
    console.print(splits, "", members, sep="\n")


def fingerprint_lines(fingerprint: object) -> list[str]:
    """What the bytes depend on besides manifest and meshes, as sentences: libraries and processor."""
    if not isinstance(fingerprint, Mapping):
        return [f"fingerprint {fingerprint}"]
    lines = []
    for name, value in fingerprint.items():
        parts = [f"{key} {one}" for key, one in value.items()] if isinstance(value, Mapping) else [str(value)]
        lines.append(f"made with {name}: {', '.join(parts)}")
    return lines


def _by_kind(part: MemberSummary) -> tuple[bool, str, str, int]:
    """The json member first, then the targets, then variant by variant, each by resolution."""
    if part.name == JSON:
        return (False, "", "", 0)
    variant, encoding, resolution = parse_member(part.name)
    return (True, "" if encoding is None else variant, encoding or "", resolution)
