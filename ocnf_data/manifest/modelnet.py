"""Folders as ModelNet has them as a source: `ROOT/category/train|test/*.off`."""

from __future__ import annotations

import posixpath
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.files.validation import Int, Strict, refused
from ocnf_data.manifest.entries import HIDDEN, SPLITS, Categories, Entry, given
from ocnf_data.meshes.listing import is_hidden, list_hidden, list_modelnet


def _count(value: Any) -> int | Literal["all"]:
    if value == "all" or (isinstance(value, int) and not isinstance(value, bool) and value >= 0):
        return value
    raise refused("not a number of meshes", expected="an integer >= 0, or all")


class Slice(Strict):
    """`count` of the sorted files of `category/folder` after the first `skip`, or as many as there are."""

    folder: str
    """Folder inside each category's folder; `.` is the category's own."""
    skip: Annotated[Int, Field(ge=0)] = 0
    """How many of the sorted files are skipped."""
    count: Annotated[int | Literal["all"], BeforeValidator(_count)]
    """How many are taken, from 0 on, or `all`."""

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
    """The folder that the paths are relative to, itself relative to the manifest's folder; `--meshes` on the
    command line takes precedence."""
    categories: Categories
    """Folders below the root: a list of names or `all`, or one of these for each split."""
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
        """The entries by split, category as listed, file name; then hidden files of the listed folders."""
        base = given(root)
        found = []
        hidden: dict[str, Entry] = {}  # by path, as two splits may share a folder
        for split in SPLITS:
            chosen: Slice = getattr(self.counts, split)
            if chosen.count != 0:
                for category in self._names(base, split):
                    files = list_modelnet(base, category, chosen.folder)
                    found += [Entry(split, category, posixpath.normpath(path)) for path in chosen.of(files)]
                    for path in map(posixpath.normpath, list_hidden(base, category, chosen.folder)):
                        hidden.setdefault(path, Entry(split, category, path, excluded=HIDDEN))
        return [*found, *hidden.values()]

    def _names(self, root: Path, split: str) -> Sequence[str]:
        chosen = self.categories[split]
        if chosen != "all":
            return chosen
        folder = getattr(self.counts, split).folder
        with storage_errors(root):
            names = sorted(p.name for p in root.iterdir()
                           if not is_hidden(p.name) and (p / folder).is_dir())
        if not names:
            raise OcnfError("no category found", code="empty", where=root, field="source.categories",
                            expected=f"folders CATEGORY/{folder} with meshes")
        return names
