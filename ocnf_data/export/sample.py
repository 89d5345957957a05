"""One sample as the formats see it: its ground truth, its chosen inputs, and where it lies in space."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.export.settings import Coordinates, ExportSettings
from ocnf_data.octree import GridOctree
from ocnf_data.shards.browse import StoredSample
from ocnf_data.shards.tarformat import JSON, parse_member, target_member

_SPHERE_MARGIN = 1.03  # DeepSDF's own: the farthest vertex lies at 1 / 1.03


@dataclass(frozen=True)
class ExportFrame:
    """Maps metres to the coordinates of a file, and these to the coordinates of the sample's mesh.

    Attributes:
        factor: coordinates in the file are metres times this.
        loc: (3,) of the mesh file: the point that lies at the origin.
        scale: coordinates of the mesh file are `points * scale + loc`.
    """

    factor: float
    loc: F64
    scale: float


@dataclass(frozen=True)
class ExportSample:
    """A stored sample and what is to be written of it.

    Attributes:
        stored: the sample.
        settings: which files are written, and how.
    """

    stored: StoredSample
    settings: ExportSettings

    @property
    def key(self) -> str:
        """The sample's name."""
        return self.stored.key

    @property
    def is_of_scan(self) -> bool:
        """Whether its ground truth is what frames of a scan have measured, and unknown elsewhere."""
        return "mesh" not in self.stored.facts

    @property
    def category(self) -> str:
        """The sample's category."""
        return self.stored.entry.category

    @cached_property
    def resolution(self) -> int:
        """Voxels along a side: what the settings say, or the largest that the sample has.

        Raises:
            OcnfError: the sample has no ground truth of that resolution, or none at all (`missing`).
        """
        known = sorted(parse_member(name)[2] for name in self._octrees if name.startswith("target-"))
        wanted = self.settings.resolution or max(known, default=None)
        if wanted is None or wanted not in known:
            raise OcnfError("the sample has no ground truth of this resolution", code="missing",
                            where=self.key, field="resolution", found=wanted,
                            expected=", ".join(map(str, known)))
        return wanted

    @property
    def target(self) -> str:
        """Member name of the ground truth."""
        return target_member(self.resolution)

    @property
    def is_tsdf(self) -> bool:
        """Whether the ground truth is a TSDF; else it is occupancy, 0 or 1."""
        return bool(self._fact("target") == "tsdf")

    @cached_property
    def inputs(self) -> dict[str, str]:
        """Member names of the chosen inputs by `VARIANT-ENCODING`.

        Raises:
            OcnfError: the settings name a variant or an encoding of which the sample has none.
        """
        found, there = {}, []
        for name in self._octrees:
            variant, encoding, resolution = parse_member(name)
            if encoding is None or resolution != self.resolution:
                continue
            there.append(f"{variant}-{encoding}")
            if self.settings.variant in (None, variant) and self.settings.encoding in (None, encoding):
                found[f"{variant}-{encoding}"] = name
        if not found and (self.settings.variant or self.settings.encoding):
            raise OcnfError("the sample has no such input", code="missing", where=self.key,
                            field="variant, encoding", expected=", ".join(there) or "none",
                            found=f"{self.settings.variant or 'any'}, {self.settings.encoding or 'any'}")
        return found

    @property
    def tsdf_inputs(self) -> dict[str, str]:
        """The members of `inputs` that are a TSDF, the plain fusion of the noisy views, by variant."""
        return {name.rpartition("-")[0]: member for name, member in self.inputs.items()
                if parse_member(member)[1] is Encoding.TSDF}

    @property
    def extent(self) -> float:
        """Side of the cube in metres."""
        return float(self._fact("normalisation")["extent"])

    @property
    def truncation(self) -> float:
        """Tau in metres: stored distances are divided by it."""
        return float(self._fact("truncation")[str(self.resolution)])

    def octree(self, member: str) -> GridOctree:
        """An octree member, decoded."""
        return self.stored.octree(member)

    def truth(self) -> GridOctree:
        """The ground truth as a TSDF.

        Raises:
            OcnfError: it is occupancy, which says too little of where the surface is.
        """
        if not self.is_tsdf:
            raise OcnfError("the ground truth is occupancy, which has no distances", code="misfit",
                            where=self.key, field="target", expected="tsdf",
                            fix="export it as dense or vdb, or generate with `target: tsdf`")
        return self.octree(self.target)

    def frame(self, default: Coordinates, radius: Callable[[], float]) -> ExportFrame:
        """The frame that the settings ask for, or the default.

        Args:
            default: coordinates to use where the settings name none.
            radius: gives the radius of the surface around the cube's centre, metres; called for the unit
                sphere alone.

        Raises:
            OcnfError: `empty` for the unit sphere around no surface.
        """
        chosen = self.settings.coordinates or default
        if chosen is Coordinates.UNIT_SPHERE:
            radius_m = radius()
            if radius_m <= 0:
                raise OcnfError("the ground truth has no surface to fit a sphere around", code="empty",
                                where=self.key, field="coordinates", found=str(chosen),
                                fix="export it in metres or in the unit cube")
            factor = 1 / (_SPHERE_MARGIN * radius_m)
        else:
            factor = 1.0 if chosen is Coordinates.METRES else 1 / self.extent
        placed = self._fact("normalisation")
        return ExportFrame(factor, np.array(placed["centre"], np.float64),
                           1 / (factor * float(placed["scale"])))

    def random(self, purpose: str) -> np.random.Generator:
        """A generator that depends on the key and the purpose alone: not on order, workers or the time."""
        digest = hashlib.sha256(f"{self.key}/{purpose}".encode()).digest()
        return np.random.default_rng(np.frombuffer(digest, np.uint32))

    @property
    def _octrees(self) -> list[str]:
        return [member.name for member in self.stored.entry.members if member.name != JSON]

    def _fact(self, name: str):  # type: ignore[no-untyped-def]
        try:
            return self.stored.facts[name]
        except KeyError:
            raise OcnfError("the sample's json member lacks a field", code="json", where=self.key,
                            field=name) from None
