"""An explicit list of mesh files as a source."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from ocnf_data.files.validation import Strict, refused
from ocnf_data.manifest.entries import SPLITS, Entry, check_category

_KEY = re.compile(r"[A-Za-z0-9_-]+")


class ListEntry(Strict):
    """One mesh file; a bare string is its path."""

    path: Annotated[str, Field(min_length=1)]
    """Path of the mesh file, relative to the root."""
    category: Annotated[str, Field(min_length=1)] = "mesh"
    """Category of the mesh, by which the loader selects and the evaluation groups; a folder's name."""
    key: str | None = None
    """Name of the sample; letters, digits, `_` and `-`, each once. None derives it from the path."""

    @model_validator(mode="after")
    def _plain_names(self) -> ListEntry:
        check_category(self.category, ".category")
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
    """The folder that the paths are relative to, itself relative to the manifest's folder, which is
    also the default; `--meshes` on the command line takes precedence."""
    items: ListItems

    def entries(self, root: Path | None = None, seed: int = 0) -> list[Entry]:
        """The entries of all splits, in the order of the lists."""
        return [Entry(split, entry.category, posixpath.normpath(entry.path), key=entry.key)
                for split in SPLITS for entry in getattr(self.items, split)]
