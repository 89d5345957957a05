"""Any folder of meshes as a source; chance assigns the splits."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr, SerializerFunctionWrapHandler, model_serializer, model_validator

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.files.validation import Int, Real, Strict, refused
from ocnf_data.manifest.entries import HIDDEN, SPLITS, Entry, given
from ocnf_data.meshes.formats import FORMATS
from ocnf_data.meshes.listing import is_hidden

Pattern = Annotated[str, Field(min_length=1)]


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

    Chance decides on its split, drawn from (seed, path) alone: adding files moves no other file. Only where
    chance leaves a share above 0 without a mesh, it takes one from the largest split: the one whose draw came
    nearest. Small sets so have something of everything that was asked for. A link to a file counts as that
    file, wherever it lies; links to folders, and hidden folders, are not entered.
    """

    kind: Literal["folder"]
    root: str | None = None
    """The folder that the paths are relative to, itself relative to the manifest's folder; `--meshes` on the
    command line takes precedence."""
    shares: SplitShares = SplitShares(train=0.8, val=0.1, test=0.1)
    at_most: Annotated[Int, Field(ge=1)] | None = None
    """Take only so many meshes, drawn from (seed, path); None takes all."""
    include: tuple[Pattern, ...] = ()
    """Take only meshes whose path from the root fits one of these patterns; none takes all. `*` stands for
    any letters, `/` among them, `?` for one, `[ab]` for one of several: `*/models/*.obj`."""
    exclude: tuple[Pattern, ...] = ()
    """Leave out meshes whose path from the root fits one of these patterns."""
    category_part: Int = 0
    """Which folder of a mesh's path names its category: 0 is the first below the root, -1 the one that the
    file lies in. `mesh` where the path has no such folder."""

    _fills: bool = PrivateAttr(default=True)

    @model_serializer(mode="wrap")
    def _as_before(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Fields that came later are left out at their defaults: data sets keep the bytes that they had."""
        fields: dict[str, Any] = plain(self)
        for name in ("include", "exclude", "category_part"):
            if getattr(self, name) == type(self).model_fields[name].default:
                del fields[name]
        return fields

    def by_chance_alone(self) -> FolderSource:
        """The same, but a share that chance leaves empty stays empty: how data sets were made at first."""
        copy = self.model_copy()
        copy._fills = False
        return copy

    @property
    def asked(self) -> tuple[str, ...]:
        """The splits with a share above 0."""
        return tuple(split for split in SPLITS if getattr(self.shares, split))

    def entries(self, root: Path | None, seed: int = 0) -> list[Entry]:
        """The entries by split and path; then the hidden files.

        Raises:
            OcnfError: no root is given, or it cannot be listed; or it has no mesh that the patterns take
                (`empty`).
        """
        base = given(root)
        below = list(_meshes_below(base))
        taken = [path for path in below if self._takes(path)]
        shown = [path for path in taken if not is_hidden(path.rpartition("/")[2])]
        paths = sorted(shown, key=lambda path: _chance(seed, path)[0])[:self.at_most]
        if not paths:
            unfit = f"{len(below)} meshes, none of which the patterns take" if below and not taken else None
            raise OcnfError("no mesh found", code="empty", where=base, field="source.root", found=unfit,
                            expected=f"files *{', *'.join(FORMATS)} in it or in its folders")
        chances = {path: _chance(seed, path)[1] for path in taken}
        splits = {path: self._split(chances[path]) for path in paths}
        if self._fills:
            self._fill(splits, chances)
        found = [Entry(split=splits[path], category=self._category(path), path=path) for path in paths]
        hidden = [Entry(split=self._split(chances[path]), category=self._category(path), path=path,
                        excluded=HIDDEN) for path in sorted(set(taken) - set(shown))]
        return [*sorted(found, key=lambda entry: (SPLITS.index(entry.split), entry.path)), *hidden]

    def _takes(self, path: str) -> bool:
        wanted = not self.include or any(fnmatchcase(path, pattern) for pattern in self.include)
        return wanted and not any(fnmatchcase(path, pattern) for pattern in self.exclude)

    def _category(self, path: str) -> str:
        folders = path.split("/")[:-1]
        inside = -len(folders) <= self.category_part < len(folders)
        return folders[self.category_part] if inside else "mesh"

    def _fill(self, splits: dict[str, str], chances: dict[str, float]) -> None:
        """Give each share that has no mesh one of the largest split's, if that has two."""
        for split in self.asked:
            counts = Counter(splits.values())
            largest = max(SPLITS, key=lambda name: counts[name])
            if counts[split] or counts[largest] < 2:
                continue
            low = sum(getattr(self.shares, before) for before in SPLITS[:SPLITS.index(split)])
            high = low + getattr(self.shares, split)
            nearest = min((path for path in splits if splits[path] == largest),
                          key=lambda path: (max(low - chances[path], chances[path] - high), path))
            splits[nearest] = split

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
