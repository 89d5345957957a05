"""Procedural scenes as a source: no files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import model_validator

from ocnf_data.files.validation import Strict, refused
from ocnf_data.manifest.entries import SPLITS, Categories, Entry
from ocnf_data.manifest.shapes import ShapeCounts


class ScenesSource(Strict):
    """Procedural rooms and tabletops. `counts` are totals: a split's scenes go to its kinds in turn."""

    kind: Literal["scenes"]
    categories: Categories
    """`rooms` and `tabletops`, or one of them."""
    counts: ShapeCounts

    @model_validator(mode="after")
    def _known(self) -> ScenesSource:
        from ocnf_data.scenes import SCENES

        for split in SPLITS:
            for i, name in enumerate(self.names(split)):
                if name not in SCENES:
                    raise refused("unknown kind of scene", at=f".categories.{split}[{i}]", found=name,
                                  expected=f"one of {', '.join(SCENES)}")
            if getattr(self.counts, split) and not self.names(split):
                raise refused("no kinds for a split that has scenes", at=f".categories.{split}")
        if not any(getattr(self.counts, split) for split in SPLITS):
            raise refused("the data set would be empty", at=".counts", expected="a count above 0")
        return self

    def entries(self, root: Path | None = None, seed: int = 0) -> list[Entry]:
        """Scene number i of a split is of kind i modulo their number."""
        return [Entry(split, names[i % len(names)], index=i // len(names))
                for split in SPLITS for names in [self.names(split)]
                for i in range(getattr(self.counts, split))]

    def names(self, split: str) -> Sequence[str]:
        """The kinds of scenes of a split."""
        from ocnf_data.scenes import SCENES

        chosen = self.categories[split]
        return SCENES if chosen == "all" else chosen
