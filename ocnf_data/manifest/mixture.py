"""Several sources as one, with weights for drawing from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ocnf_data.files.validation import NotEmpty, Strict, refused
from ocnf_data.manifest.entries import Entry
from ocnf_data.manifest.explicit import ListSource
from ocnf_data.manifest.folder import FolderSource
from ocnf_data.manifest.modelnet import ModelNetSource
from ocnf_data.manifest.scenes import ScenesSource
from ocnf_data.manifest.shapes import ShapesSource
from ocnf_data.manifest.synthesis import DrawWeight

PlainSource = Annotated[ShapesSource | ModelNetSource | FolderSource | ListSource | ScenesSource,
                        Field(discriminator="kind")]


class SourcePart(Strict):
    """One source of several."""

    weight: DrawWeight = 1.0
    """How often `SynthesisDataset` draws from it, relative to the others. `generate` takes all its meshes."""
    source: PlainSource
    """The meshes and their splits: a source of any kind but a mixture."""


class MixtureSource(Strict):
    """Several sources as one; all mesh files lie below the one root."""

    kind: Literal["mixture"]
    root: str | None = None
    """The folder that the paths of all sources are relative to; `--meshes` on the command line takes
    precedence."""
    parts: Annotated[tuple[SourcePart, ...], NotEmpty]
    """The sources, one or more."""

    @model_validator(mode="after")
    def _one_root(self) -> MixtureSource:
        for i, part in enumerate(self.parts):
            root = getattr(part.source, "root", None)
            if root is not None:
                raise refused("the parts of a mixture have no folders of their own",
                              at=f".parts[{i}].source.root", found=root,
                              expected="one root of the mixture, and paths of the parts relative to it")
        return self

    def entries(self, root: Path | None, seed: int = 0) -> list[Entry]:
        """The entries of each part, in order."""
        return [entry for part in self.parts for entry in part.source.entries(root, seed)]

    def by_chance_alone(self) -> MixtureSource:
        """The same, with folders that leave a share empty if chance does."""
        parts = tuple(part.model_copy(update={"source": part.source.by_chance_alone()})
                      if isinstance(part.source, FolderSource) else part for part in self.parts)
        return self.model_copy(update={"parts": parts})

    @property
    def reads_files(self) -> bool:
        """Whether some part is of mesh files."""
        return any(part.source.kind not in ("shapes", "scenes") for part in self.parts)
