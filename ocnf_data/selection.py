"""Which meshes make up a data set, split by split: the `source` of a manifest.

Four kinds: `shapes` (procedural, no files), `modelnet` (`ROOT/category/folder/*.off`), `folder` (every mesh
anywhere below a folder) and `list` (explicit paths). Each gives its `entries` in a fixed order, and none of
them may name the same mesh twice, in one split or in two.
"""

from __future__ import annotations

import hashlib
import json
import os
import posixpath
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from ocnf_data.errors import OcnfError
from ocnf_data.sources.formats import FORMATS
from ocnf_data.sources.listing import list_modelnet
from ocnf_data.storage import storage_errors
from ocnf_data.validation import Int, Real, Strict, refuse_repeats, refused

SPLITS = ("train", "val", "test")
_KEY = re.compile(r"[A-Za-z0-9_-]+")


@dataclass(frozen=True)
class Entry:
    """One mesh of a data set: either a file (`path`) or the `index`-th procedural shape of its category."""

    split: str
    category: str
    path: str | None = None
    """POSIX, relative to the meshes' root (or absolute, where a list says so)."""
    index: int | None = None
    """Counts within category and split, from 0."""
    key: str | None = None
    """The key an explicit list gives it."""


# ---- categories


class SplitCategories(Strict):
    """The categories of each split; "all" are those that the folder has."""

    train: tuple[str, ...] | Literal["all"] = ()
    val: tuple[str, ...] | Literal["all"] = ()
    test: tuple[str, ...] | Literal["all"] = ()

    def __getitem__(self, split: str) -> tuple[str, ...] | Literal["all"]:
        chosen: tuple[str, ...] | Literal["all"] = getattr(self, split)
        return chosen


def _split_categories(value: Any) -> SplitCategories:
    """One list for all splits, or a mapping from split to list; "all" for a list."""
    if isinstance(value, SplitCategories):
        return value
    if not isinstance(value, Mapping):
        chosen = _categories(value, "")
        return SplitCategories(train=chosen, val=chosen, test=chosen)
    for split in value:
        if split not in SPLITS:
            raise refused("unknown split", at=f".{split}", found=split, expected="train, val, test")
    return SplitCategories(**{split: _categories(chosen, f".{split}") for split, chosen in value.items()})


def _categories(value: Any, at: str) -> tuple[str, ...] | Literal["all"]:
    if value == "all":
        return "all"
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise refused("not a list of categories", at=at, found=value, expected="a list of names, or all")
    for i, name in enumerate(value):
        if name in ("", ".", "..") or any(c in name for c in "/\\\0"):
            raise refused("not a folder's name", at=f"{at}[{i}]", found=name, expected="no /, \\, . or ..")
    refuse_repeats(value, at)
    return tuple(value)


Categories = Annotated[SplitCategories, BeforeValidator(_split_categories)]


# ---- procedural shapes


class ShapeCounts(Strict):
    """Shapes in each split, all categories together."""

    train: Annotated[Int, Field(ge=0)] = 0
    val: Annotated[Int, Field(ge=0)] = 0
    test: Annotated[Int, Field(ge=0)] = 0


class ShapesSource(Strict):
    """Procedural shapes. `counts` are totals: a split's shapes are dealt to its categories in turn."""

    kind: Literal["shapes"]
    categories: Categories
    counts: ShapeCounts

    @model_validator(mode="after")
    def _known(self) -> ShapesSource:
        from ocnf_data.sources.shapes import CATEGORIES

        for split in SPLITS:
            for i, name in enumerate(self._names(split)):
                if name not in CATEGORIES:
                    raise refused("unknown shape", at=f".categories.{split}[{i}]", found=name,
                                  expected=f"one of {', '.join(CATEGORIES)}")
            if getattr(self.counts, split) and not self._names(split):
                raise refused("no categories for a split that has shapes", at=f".categories.{split}")
        if not any(getattr(self.counts, split) for split in SPLITS):
            raise refused("the data set would be empty", at=".counts", expected="a count above 0")
        return self

    def entries(self, root: Path | None = None, seed: int = 0) -> list[Entry]:
        """Shape number i of a split is of category i modulo their number."""
        return [Entry(split, names[i % len(names)], index=i // len(names))
                for split in SPLITS for names in [self._names(split)]
                for i in range(getattr(self.counts, split))]

    def _names(self, split: str) -> Sequence[str]:
        from ocnf_data.sources.shapes import CATEGORIES

        chosen = self.categories[split]
        return CATEGORIES if chosen == "all" else chosen


# ---- folders as ModelNet has them


def _count(value: Any) -> int | Literal["all"]:
    if value == "all" or (isinstance(value, int) and not isinstance(value, bool) and value >= 0):
        return value
    raise refused("not a number of meshes", expected="an integer >= 0, or all")


class Slice(Strict):
    """`count` of the sorted files of `category/folder` after the first `skip`, or as many as there are."""

    folder: str
    skip: Annotated[Int, Field(ge=0)] = 0
    count: Annotated[int | Literal["all"], BeforeValidator(_count)]

    @model_validator(mode="after")
    def _one_folder(self) -> Slice:
        if self.folder in ("", "..") or any(c in self.folder for c in "/\\\0"):
            raise refused("not a folder's name", at=".folder", found=self.folder,
                          expected="a folder in each category's, or . for the category's own")
        return self

    @property
    def end(self) -> float:
        """Position after the last one."""
        return float("inf") if self.count == "all" else self.skip + self.count

    def of(self, files: Sequence[str]) -> Sequence[str]:
        """The chosen ones of the sorted files."""
        return files[self.skip:] if self.count == "all" else files[self.skip:self.skip + self.count]


class ModelNetCounts(Strict):
    """Meshes **of each category** in each split.

    A number n (or `all`) stands for the first n files: train those of the folder `train`, test those of
    `test`, and val the n files of `train` that come after train's, because ModelNet has no folder for it.
    """

    train: Slice = Slice(folder="train", count=0)
    val: Slice = Slice(folder="train", count=0)
    test: Slice = Slice(folder="test", count=0)

    @model_validator(mode="before")
    @classmethod
    def _spelled_out(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        full = {split: {"folder": "test" if split == "test" else "train", "count": value}
                if split in SPLITS and not isinstance(value, Mapping | Slice) else value
                for split, value in data.items()}
        train = full.get("train")
        if "val" in full and full["val"] is not data["val"] and isinstance(train, Mapping) \
                and train.get("folder") == "train":
            start, count = train.get("skip", 0), train.get("count")
            if count == "all" and data["val"] != 0:
                raise refused("train takes all files of its folder, so val has none left", at=".val",
                              expected="a folder of its own, such as {folder: test, count: 5}")
            if isinstance(start, int) and isinstance(count, int):
                full["val"] = {**full["val"], "skip": start + count}
        return full


class ModelNetSource(Strict):
    """`ROOT/category/folder/*.off` (or any other mesh format)."""

    kind: Literal["modelnet"]
    root: str | None = None
    """Relative to the manifest; `--meshes` goes before it."""
    categories: Categories
    counts: ModelNetCounts

    @model_validator(mode="after")
    def _no_mesh_twice(self) -> ModelNetSource:
        slices = {split: getattr(self.counts, split) for split in SPLITS}
        used = [split for split in SPLITS if slices[split].count != 0]
        if not used:
            raise refused("the data set would be empty", at=".counts", expected="a count above 0")
        for i, a in enumerate(used):
            if self.categories[a] == ():
                raise refused("no categories for a split that has meshes", at=f".categories.{a}")
            for b in used[:i]:
                shared = slices[a].folder == slices[b].folder and max(slices[a].skip, slices[b].skip) < min(
                    slices[a].end, slices[b].end)
                if shared and self._common_category(a, b):
                    raise refused(f"{a} and {b} would hold the same meshes", at=f".counts.{a}",
                                  expected="other files of the folder (skip), or another folder")
        return self

    def _common_category(self, a: str, b: str) -> bool:
        first, second = self.categories[a], self.categories[b]
        return first == "all" or second == "all" or bool(set(first) & set(second))

    def entries(self, root: Path | None, seed: int = 0) -> list[Entry]:
        """By split, category as listed, file name."""
        base = _given(root)
        found = []
        for split in SPLITS:
            chosen: Slice = getattr(self.counts, split)
            if chosen.count != 0:
                for category in self._names(base, split):
                    files = list_modelnet(base, category, chosen.folder)
                    found += [Entry(split, category, posixpath.normpath(path)) for path in chosen.of(files)]
        return found

    def _names(self, root: Path, split: str) -> Sequence[str]:
        chosen = self.categories[split]
        if chosen != "all":
            return chosen
        folder = getattr(self.counts, split).folder
        with storage_errors(root):
            names = sorted(p.name for p in root.iterdir()
                           if not p.name.startswith(".") and (p / folder).is_dir())
        if not names:
            raise OcnfError("no category found", code="empty", where=root, field="source.categories",
                            expected=f"folders CATEGORY/{folder} with meshes")
        return names


# ---- any folder


class SplitShares(Strict):
    """Share of the meshes in each split; they sum to 1."""

    train: Annotated[Real, Field(ge=0, le=1)] = 0.0
    val: Annotated[Real, Field(ge=0, le=1)] = 0.0
    test: Annotated[Real, Field(ge=0, le=1)] = 0.0

    @model_validator(mode="after")
    def _whole(self) -> SplitShares:
        total = self.train + self.val + self.test
        if abs(total - 1) > 1e-6:
            raise refused("the shares do not sum to 1", found=total, expected="1")
        return self


class FolderSource(Strict):
    """Every mesh below a folder. A mesh's category is the first folder of its path, `mesh` at the top.

    Chance decides on its split, drawn from (seed, path) alone: adding files moves no other file.
    """

    kind: Literal["folder"]
    root: str | None = None
    shares: SplitShares = SplitShares(train=0.8, val=0.1, test=0.1)
    at_most: Annotated[Int, Field(ge=1)] | None = None
    """Take only so many of them, drawn likewise."""

    def entries(self, root: Path | None, seed: int = 0) -> list[Entry]:
        """By split and path."""
        base = _given(root)
        paths = sorted(_meshes_below(base), key=lambda path: _chance(seed, path)[0])[:self.at_most]
        if not paths:
            raise OcnfError("no mesh found", code="empty", where=base, field="source.root",
                            expected=f"files *{', *'.join(FORMATS)} in it or in its folders")
        found = [Entry(split=self._split(_chance(seed, path)[1]),
                       category=path.split("/")[0] if "/" in path else "mesh", path=path) for path in paths]
        return sorted(found, key=lambda entry: (SPLITS.index(entry.split), entry.path))

    def _split(self, chance: float) -> str:
        last = [split for split in SPLITS if getattr(self.shares, split)][-1]
        reached = 0.0
        for split in SPLITS:
            reached += getattr(self.shares, split)
            if chance < reached:
                return split
        return last  # 0.1 + 0.2 + 0.7 falls short of 1 by a rounding


def _chance(seed: int, path: str) -> tuple[float, float]:
    """Two numbers in [0, 1) from seed and path: the place in the draw, and the place among the splits."""
    digest = hashlib.sha256(json.dumps([seed, path]).encode()).digest()
    order, split = (int.from_bytes(digest[i:i + 8], "little") >> 11 for i in (0, 8))
    return order / 2**53, split / 2**53


def _meshes_below(root: Path) -> Iterator[str]:
    """POSIX paths of all mesh files, relative to the root; hidden files and folders are passed over."""

    def fail(error: OSError) -> None:  # os.walk's default is to skip unreadable folders in silence
        raise error

    with storage_errors(root):
        for folder, folders, files in os.walk(root, onerror=fail):
            folders[:] = [name for name in folders if not name.startswith(".")]
            for name in files:
                if Path(name).suffix.lower() in FORMATS and not name.startswith("."):
                    yield (Path(folder) / name).relative_to(root).as_posix()


# ---- explicit lists


class ListEntry(Strict):
    """One mesh file; a bare string is its path."""

    path: Annotated[str, Field(min_length=1)]
    category: Annotated[str, Field(min_length=1)] = "mesh"
    key: str | None = None

    @model_validator(mode="after")
    def _plain_key(self) -> ListEntry:
        if self.key is not None and not _KEY.fullmatch(self.key):
            raise refused("not a key", at=".key", found=self.key, expected="letters, digits, _ and -")
        return self


def _as_entry(value: Any) -> Any:
    return {"path": value} if isinstance(value, str) else value


ListEntries = tuple[Annotated[ListEntry, BeforeValidator(_as_entry)], ...]


class ListItems(Strict):
    """The mesh files of each split."""

    train: ListEntries = ()
    val: ListEntries = ()
    test: ListEntries = ()

    @model_validator(mode="after")
    def _no_mesh_twice(self) -> ListItems:
        seen: dict[tuple[str, str], str] = {}
        for split in SPLITS:
            for i, entry in enumerate(getattr(self, split)):
                place = f".{split}[{i}]"
                for field, value in (("path", posixpath.normpath(entry.path)), ("key", entry.key)):
                    if value is not None and (field, value) in seen:
                        raise refused("listed twice", at=f"{place}.{field}", found=value,
                                      expected=f"each once (it is also {seen[field, value]})")
                    if value is not None:
                        seen[field, value] = f"{split}[{i}]"
        if not seen:
            raise refused("the data set would be empty", expected="a path in some split")
        return self


class ListSource(Strict):
    """Explicit paths, relative to the root, or where none is given to the manifest's own folder."""

    kind: Literal["list"]
    root: str | None = None
    items: ListItems

    def entries(self, root: Path | None = None, seed: int = 0) -> list[Entry]:
        """As listed."""
        return [Entry(split, entry.category, posixpath.normpath(entry.path), key=entry.key)
                for split in SPLITS for entry in getattr(self.items, split)]


def no_root(where: object = None) -> OcnfError:
    """The error for a source of files whose root folder nobody gave."""
    return OcnfError("the folder of the meshes is not given", code="missing", where=where,
                     field="source.root",
                     fix="give it as --meshes ROOT, or as source.root in the manifest")


def _given(root: Path | None) -> Path:
    if root is None:
        raise no_root()
    return root
