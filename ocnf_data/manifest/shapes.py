"""Procedural shapes as a source: no files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ocnf_data.files.validation import Int, Strict, refused
from ocnf_data.manifest.entries import SPLITS, Categories, Entry


class ShapeCounts(Strict):
    """Shapes in each split, all categories together."""

    train: Annotated[Int, Field(ge=0)] = 0
    val: Annotated[Int, Field(ge=0)] = 0
    test: Annotated[Int, Field(ge=0)] = 0


class ShapesSource(Strict):
    """Procedural shapes. `counts` are totals: a split's shapes go to its categories in turn."""

    kind: Literal["shapes"]
    categories: Categories
    """Kinds of shapes: a list of names or `all`, or one of these for each split."""
    counts: ShapeCounts

    @model_validator(mode="after")
    def _known(self) -> ShapesSource:
        from ocnf_data.shapes import CATEGORIES

        for split in SPLITS:
            for i, name in enumerate(self.names(split)):
                if name not in CATEGORIES:
                    raise refused("unknown shape", at=f".categories.{split}[{i}]", found=name,
                                  expected=f"one of {', '.join(CATEGORIES)}")
            if getattr(self.counts, split) and not self.names(split):
                raise refused("no categories for a split that has shapes", at=f".categories.{split}")
        if not any(getattr(self.counts, split) for split in SPLITS):
            raise refused("the data set would be empty", at=".counts", expected="a count above 0")
        return self

    def entries(self, root: Path | None = None, seed: int = 0) -> list[Entry]:
        """Shape number i of a split is of category i modulo their number."""
        return [Entry(split, names[i % len(names)], index=i // len(names))
                for split in SPLITS for names in [self.names(split)]
                for i in range(getattr(self.counts, split))]

    def names(self, split: str) -> Sequence[str]:
        """The categories of a split."""
        from ocnf_data.shapes import CATEGORIES

        chosen = self.categories[split]
        return CATEGORIES if chosen == "all" else chosen
