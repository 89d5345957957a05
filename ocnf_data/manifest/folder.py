"""Any folder of meshes as a source; chance assigns the splits."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import storage_errors
from ocnf_data.files.validation import Int, Real, Strict, refused
from ocnf_data.manifest.entries import HIDDEN, SPLITS, Entry, given
from ocnf_data.meshes.formats import FORMATS
from ocnf_data.meshes.listing import is_hidden


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

    Chance decides on its split, drawn from (seed, path) alone: adding files moves no other file. A link to a
    file counts as that file, wherever it lies; links to folders, and hidden folders, are not entered.
    """

    kind: Literal["folder"]
    root: str | None = None
    """The folder that the paths are relative to, itself relative to the manifest's folder; `--meshes` on the
    command line takes precedence."""
    shares: SplitShares = SplitShares(train=0.8, val=0.1, test=0.1)
    at_most: Annotated[Int, Field(ge=1)] | None = None
    """Take only so many meshes, drawn from (seed, path); None takes all."""

    def entries(self, root: Path | None, seed: int = 0) -> list[Entry]:
        """The entries by split and path; then the hidden files."""
        base = given(root)
        below = list(_meshes_below(base))
        shown = [path for path in below if not is_hidden(path.rpartition("/")[2])]
        paths = sorted(shown, key=lambda path: _chance(seed, path)[0])[:self.at_most]
        if not paths:
            raise OcnfError("no mesh found", code="empty", where=base, field="source.root",
                            expected=f"files *{', *'.join(FORMATS)} in it or in its folders")
        found = [self._entry(seed, path) for path in paths]
        hidden = [self._entry(seed, path, HIDDEN) for path in sorted(set(below) - set(shown))]
        return [*sorted(found, key=lambda entry: (SPLITS.index(entry.split), entry.path)), *hidden]

    def _entry(self, seed: int, path: str, excluded: str | None = None) -> Entry:
        return Entry(split=self._split(_chance(seed, path)[1]),
                     category=path.split("/")[0] if "/" in path else "mesh", path=path, excluded=excluded)

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
    """POSIX paths of all mesh files, relative to the root; hidden ones too, but not in hidden folders."""

    def fail(error: OSError) -> None:  # os.walk's default is to skip unreadable folders in silence
        raise error

    with storage_errors(root):
        for folder, folders, files in os.walk(root, onerror=fail):
            folders[:] = [name for name in folders if not is_hidden(name)]
            for name in files:
                if Path(name).suffix.lower() in FORMATS:
                    yield (Path(folder) / name).relative_to(root).as_posix()
