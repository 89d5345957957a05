"""What every source gives: its entries, each with a split and a category."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

from ocnf_data.errors import OcnfError
from ocnf_data.files.validation import Strict, refuse_repeats, refused

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Entry:
    """One input of a data set.

    Either a mesh file (`path`), or the `index`-th procedural shape of its category, or, with both, the
    `index`-th configuration of a scan.
    """

    split: str
    category: str
    path: str | None = None
    """POSIX path of the mesh file or of the scan's folder, relative to the root (or absolute, where a list
    says so)."""
    index: int | None = None
    """Number of the procedural shape within its category and split, or of the configuration within its scan
    and split, from 0."""
    key: str | None = None
    """The key an explicit list gives it."""
    excluded: str | None = None
    """Why the mesh is left out; it is counted nevertheless."""


HIDDEN = "is hidden: its name begins with a dot"
"""Why `.chair_0001.off` is left out (editors, and macOS with `._chair_0001.off`, leave such files)."""


class SplitCategories(Strict):
    """The categories of each split: a list of names, or `all` for those that there are."""

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
        check_category(name, f"{at}[{i}]")
    refuse_repeats(value, at)
    return tuple(value)


def check_category(name: str, at: str = "") -> None:
    """Raise `refused` unless it can be the name of a folder, as it is where samples are exported."""
    if name in ("", ".", "..") or any(c in name for c in "/\\\0"):
        raise refused("not a folder's name", at=at, found=name, expected="no /, \\, . or ..")


Categories = Annotated[SplitCategories, BeforeValidator(_split_categories)]


def no_root(where: object = None) -> OcnfError:
    """The error for a source of files whose root folder nobody gave."""
    return OcnfError("the folder of the meshes or scans is not given", code="missing", where=where,
                     field="source.root",
                     fix="give it as --meshes ROOT, or as source.root in the manifest")


def given(root: Path | None) -> Path:
    """The root folder; OcnfError (`missing`) where nobody gave one."""
    if root is None:
        raise no_root()
    return root
