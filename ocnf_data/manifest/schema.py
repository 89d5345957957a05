"""What a data set is: a typed, validated manifest, written as YAML.

>>> manifest = load_manifest("manifests/demo.yaml")
>>> manifest.inputs[0].views, round(manifest.truncation(256), 6)
(4, 0.025)

Every field but `name`, `source` and `inputs` has a default, the paper's setting. `to_dict` fills them all in:
that is what a data set records about itself, and what `manifest_difference` compares before a run resumes.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import (
    BeforeValidator,
    Field,
    PrivateAttr,
    field_validator,
    model_validator,
)

from ocnf_data.files.strict_yaml import read_yaml
from ocnf_data.files.validation import Int, NotEmpty, Real, Strict, refuse_repeats, refused, validate
from ocnf_data.manifest.camera import Camera, Normalise
from ocnf_data.manifest.entries import Entry, no_root
from ocnf_data.manifest.explicit import ListSource
from ocnf_data.manifest.folder import FolderSource
from ocnf_data.manifest.mixture import MixtureSource
from ocnf_data.manifest.modelnet import ModelNetSource
from ocnf_data.manifest.scenes import ScenesSource
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.manifest.shapes import ShapesSource
from ocnf_data.manifest.synthesis import Synthesis
from ocnf_data.manifest.variant import Variant
from ocnf_data.views.rigs import view_subset

SCHEMA = 1
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


class Target(StrEnum):
    """What the network learns to predict, stored at every resolution."""

    TSDF = "tsdf"
    """TSDF of all views of the rig, divided by tau."""
    OCCUPANCY = "occupancy"
    """1 where that TSDF is negative, else 0."""


class Shards(Strict):
    """How samples are packed."""

    samples: Annotated[Int, Field(ge=1, le=100_000)] = 16
    """Samples in a shard, which is also the unit of work of one worker."""


class Limits(Strict):
    """When an item or a run is given up."""

    timeout_s: Annotated[Real, Field(gt=0)] = 300.0
    """Seconds of wall time an item may take."""
    max_faces: Annotated[Int, Field(ge=1)] = 5_000_000
    """Most triangles of a mesh that is read."""
    max_bytes: Annotated[Int, Field(ge=1)] = 256 * 2**20
    """Largest mesh file that is read, bytes."""
    failure_threshold: Annotated[Real, Field(ge=0, le=1)] = 0.05
    """Share of failed items above which the run's exit status is not 0."""


def _known_schema(value: Any) -> Any:
    if value != SCHEMA or isinstance(value, bool):
        raise refused("this version of the manifest format cannot be read",
                      expected=f"{SCHEMA} (a later one needs a later ocnf)")
    return value


class Manifest(Strict):
    """A data set's definition. Two manifests are equal when they define the same data set."""

    schema_version: Annotated[int, Field(alias="schema"), BeforeValidator(_known_schema)] = SCHEMA
    """Version of the manifest's format."""
    name: str
    """Name of the data set; letters, digits, `_`, `-` and `.`, not `-` or `.` at first."""
    seed: Annotated[Int, Field(ge=0, lt=2**63)] = 0
    """Seed of all that is drawn: procedural shapes, splits of a folder, the order of items, the noise."""
    source: Annotated[ShapesSource | ModelNetSource | FolderSource | ListSource | MixtureSource
                      | ScenesSource | SequenceSource,
                      Field(discriminator="kind")]
    """The meshes, or the scans, and their splits; `kind` says which of the seven."""
    normalise: Normalise = Normalise()
    camera: Camera = Camera()
    renderer: Literal["raster", "pyrender"] = "raster"
    """`raster` runs on the CPU and is the more exact; `pyrender` draws with OpenGL (extra `gl`)."""
    resolutions: Annotated[tuple[Int, ...], NotEmpty] = (64, 128, 256)
    """Voxels along each side of the cube, ascending; multiples of 8 from 8 to 1024."""
    truncation_voxels: Annotated[Real, Field(gt=0, le=64)] = 32 / 15
    """Truncation distance tau on each side of the surface, voxels; 32 / 15 is 0.025 m at 256^3 over 3 m."""
    target: Target = Target.TSDF
    """The ground truth, fused from all views of the rig without noise."""
    inputs: Annotated[tuple[Variant, ...], NotEmpty]
    """What a network gets to see: one or more variants."""
    shards: Shards = Shards()
    views: Literal["drop", "keep"] = "drop"
    """`keep`: the rendered depth stays in OUT/views, and later runs need not render again."""
    limits: Limits = Limits()
    synthesis: Synthesis | None = None
    """What `SynthesisDataset` draws for every sample; no part of what `generate` makes."""

    _folder: Path | None = PrivateAttr(default=None)

    @field_validator("name")
    @classmethod
    def _plain_name(cls, name: str) -> str:
        if not _NAME.fullmatch(name):
            raise refused("not a name for a data set", expected="letters, digits, _, - and .")
        return name

    @field_validator("resolutions")
    @classmethod
    def _whole_trees(cls, resolutions: tuple[int, ...]) -> tuple[int, ...]:
        for i, resolution in enumerate(resolutions):
            if not 8 <= resolution <= 1024 or resolution % 8:
                raise refused("not a resolution", at=f"[{i}]", found=resolution,
                              expected="a multiple of 8 from 8 to 1024 (a tree is 8 voxels wide)")
            if i and resolution <= resolutions[i - 1]:
                raise refused("the resolutions are not ascending", at=f"[{i}]", found=resolution,
                              expected=f"more than the {resolutions[i - 1]} before it")
        return resolutions

    @field_validator("inputs")
    @classmethod
    def _distinct_names(cls, inputs: tuple[Variant, ...]) -> tuple[Variant, ...]:
        refuse_repeats([variant.name for variant in inputs], after=".name")
        return inputs

    @model_validator(mode="after")
    def _fields_fit_together(self) -> Manifest:
        if isinstance(self.source, SequenceSource):
            return self._fit_for_scans()
        n = self.camera.n_views
        for i, variant in enumerate(self.inputs):
            if variant.views > n:
                raise refused(f"the rig {self.camera.rig} has fewer views", at=f"inputs[{i}].views",
                              found=variant.views, expected=f"1 to {n}")
        if self.synthesis is not None and self.synthesis.views[1] > n:
            raise refused(f"the rig {self.camera.rig} has fewer views", at="synthesis.views[1]",
                          found=self.synthesis.views[1], expected=f"1 to {n}")
        if self.synthesis is not None and self.camera.path is not None and not all(self._are_scenes()):
            raise refused("a hand-held path cannot be drawn from", at="camera.rig", found=self.camera.rig,
                          expected="a rig of directions where synthesis draws anything but scenes")
        if self.synthesis is not None and not any(self._are_scenes()):
            given, default = (section.model_dump(mode="json") for section in (self.synthesis, Synthesis()))
            for field in ("zoom", "cameras"):
                if given[field] != default[field]:
                    raise refused(f"{field} belongs to scenes", at=f"synthesis.{field}", found=given[field],
                                  expected="none without a source of kind scenes")
        if self.camera.path is None and self.camera.distance <= self.normalise.radius:
            raise refused("the cameras would stand inside the bounding sphere of the meshes",
                          at="camera.distance", found=self.camera.distance,
                          expected=f"more than {self.normalise.radius:.4g} m")
        return self

    def _are_scenes(self) -> list[bool]:
        """Whether they are scenes, of each source."""
        parts = [part.source for part in self.source.parts] if isinstance(self.source, MixtureSource) else [
            self.source]
        return [isinstance(source, ScenesSource) for source in parts]

    def _fit_for_scans(self) -> Manifest:
        if self.camera != Camera():
            raise refused("the cameras of scans are their own", at="camera", expected="no camera section")
        if self.synthesis is not None:
            raise refused("samples without end are drawn of meshes, shapes and scenes, not of scans",
                          at="synthesis", expected="no synthesis section")
        return self

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: object = "manifest") -> Manifest:
        """The manifest of a plain dict, as `to_dict` gives it or with defaults left out."""
        return validate(cls, data, where)

    def to_dict(self) -> dict[str, Any]:
        """The resolved manifest, defaults filled in, in JSON's types."""
        fields = self.model_dump(mode="json", by_alias=True)
        if self.synthesis is None:  # so data sets without it keep the bytes that they had before it existed
            del fields["synthesis"]
        return fields

    def canonical_json(self) -> str:
        """`to_dict` as JSON with sorted keys and no spaces: equal for equal manifests, so fit for hashing."""
        return json.dumps(self.to_dict(), sort_keys=True, separators=(",", ":"), allow_nan=False)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Manifest) and self.canonical_json() == other.canonical_json()

    def __hash__(self) -> int:
        return hash(self.canonical_json())

    def by_chance_alone(self) -> Manifest:
        """The same, with folders' splits as they were drawn before empty ones were given a mesh."""
        if isinstance(self.source, FolderSource):
            source: FolderSource | MixtureSource = self.source.by_chance_alone()
        elif isinstance(self.source, MixtureSource):
            source = self.source.by_chance_alone()
        else:
            return self
        return self.model_copy(update={"source": source})

    def truncation(self, resolution: int) -> float:
        """Truncation distance tau at a resolution, metres."""
        return self.truncation_voxels * self.normalise.extent / resolution

    def view_indices(self, variant: Variant) -> tuple[int, ...]:
        """Which views of the rig an input sees."""
        return tuple(int(i) for i in view_subset(self.camera.n_views, variant.views))

    @property
    def most_views(self) -> int:
        """Number of views of the input that sees the most."""
        return max(variant.views for variant in self.inputs)

    def entries(self, root: Path | None) -> list[Entry]:
        """The entries of the source, in a fixed order.

        Args:
            root: what `meshes_root` gives.
        """
        if isinstance(self.source, SequenceSource):
            return self.source.entries(root, self.seed, self.most_views)
        return self.source.entries(root, self.seed)

    def meshes_root(self, override: str | os.PathLike[str] | None = None) -> Path | None:
        """The folder that the paths of meshes or scans are relative to; None for procedural shapes.

        Args:
            override: `--meshes` (or `--root`); wins over the manifest's `source.root`, which is relative to
                the manifest.

        Raises:
            OcnfError: neither is given.
        """
        if isinstance(self.source, ShapesSource | ScenesSource) or \
                (isinstance(self.source, MixtureSource) and not self.source.reads_files):
            return None
        if override is not None:
            return Path(override).expanduser().absolute()
        if self.source.root is not None:
            return (self._folder or Path()).joinpath(Path(self.source.root).expanduser()).absolute()
        if isinstance(self.source, ListSource) and self._folder is not None:
            return self._folder
        raise no_root(self.name)


def load_manifest(path: str | os.PathLike[str]) -> Manifest:
    """Read a manifest.

    Raises:
        OcnfError: the file cannot be read, is not YAML, or has fields that are unknown, missing or wrong:
            all of them in one message, each with its path, its value and what is allowed; or a field of
            `synthesis` would have no effect.
    """
    manifest = validate(Manifest, read_yaml(path), path)
    if manifest.synthesis is not None:
        manifest.synthesis.refuse_idle(path)
    manifest._folder = Path(path).absolute().parent
    return manifest


class Difference(NamedTuple):
    """A field in which two manifests differ; a field that only one of them has is `absent` in the other."""

    field: str
    before: Any
    now: Any

    def __str__(self) -> str:
        return f"{self.field}: {self.before!r} before, {self.now!r} now"


class _Absent:
    def __repr__(self) -> str:
        return "absent"


ABSENT = _Absent()


def manifest_difference(before: Manifest | Mapping[str, Any], now: Manifest | Mapping[str, Any],
               ignore: Sequence[str] = ("source.root",)) -> list[Difference]:
    """The fields in which two manifests (or what `to_dict` gave for them) differ.

    Args:
        before: the one a data set was begun with.
        now: the one it is to be resumed with.
        ignore: paths that do not count. Where the meshes lie does not: their checksums do, elsewhere.
    """
    dicts = [m.to_dict() if isinstance(m, Manifest) else m for m in (before, now)]
    return [found for found in _differences("", *dicts) if found.field not in ignore]


def _differences(path: str, a: Any, b: Any) -> Iterator[Difference]:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in [*a, *(key for key in b if key not in a)]:
            below = f"{path}.{key}" if path else str(key)
            yield from _differences(below, a.get(key, ABSENT), b.get(key, ABSENT))
    elif isinstance(a, list) and isinstance(b, list):
        for i, (x, y) in enumerate(zip_longest(a, b, fillvalue=ABSENT)):
            yield from _differences(f"{path}[{i}]", x, y)
    elif a != b or type(a) is not type(b):
        yield Difference(path, a, b)
