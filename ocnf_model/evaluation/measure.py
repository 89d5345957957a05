"""Each method on each model: the figures, and the surfaces that are to be drawn."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

import torch

from ocnf_data.arrays import F64, I64
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_model.baselines import tvl1
from ocnf_model.evaluation.levels import run_levels, stored_volfus
from ocnf_model.evaluation.methods import Method
from ocnf_model.evaluation.models import DatasetFacts, Model, VariantPlan
from ocnf_model.evaluation.origins import Origins
from ocnf_model.measures.figures import THICK, SurfaceFigures, measure_surface
from ocnf_model.measures.reference import Reference
from ocnf_model.measures.regions import EXACT, Regions, mad_by_region, seen_by
from ocnf_model.measures.surface import Surface
from ocnf_model.metrics import known_mad_mm, mad_mm, occupancy_overlap, tsdf_overlap
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.octree.batch import OctreeBatch

MeshArrays = tuple[F64, I64]
TRUTH = "Ground truth"
"""Label of the ground truth beside those of the methods."""
Weight = Callable[[str, int], float]
"""TV-L1's weight for a (variant, resolution)."""


@dataclass(frozen=True)
class Row:
    """The figures of one method on one model.

    Attributes:
        key, category: key and category of the model.
        variant: name of the input variant.
        resolution: voxels along each axis.
        method: label of the method.
        mad_mm: over all voxels; NaN where prediction or ground truth is occupancy.
        iou, precision, recall: measures of the occupied voxels (TSDF < 0, probability >= 0.5), 0 to 1.
        seconds: time from the encoded input to the reconstruction; NaN for what is read from the data set.
        n_leaves: number of leaves of the reconstruction.
        regions: contributions to the MAD by region.
        surface: how the surface lies to the true one.
        known_mm: `mad_mm` over the voxels where the truth is not exactly -tau; NaN as there.
    """

    key: str
    category: str
    variant: str
    resolution: int
    method: str
    mad_mm: float
    iou: float
    precision: float
    recall: float
    seconds: float
    n_leaves: int
    regions: Regions = field(default_factory=Regions)
    surface: SurfaceFigures = field(default_factory=SurfaceFigures)
    known_mm: float = math.nan


@dataclass(frozen=True, eq=False)
class Field:
    """A reconstruction or a ground truth: one volume, TSDF / tau or the probability of being occupied."""

    volume: OctreeBatch
    is_occupancy: bool

    def as_occupancy(self) -> OctreeBatch:
        """1 where it is occupied, 0 elsewhere."""
        values = self.volume.features
        inside = values >= 0.5 if self.is_occupancy else values < 0
        return self.volume.with_features(inside.to(torch.float32))

    def signed(self) -> GridOctree:
        """TSDF / tau in [-1, 1], or 1 - 2 occupancy: negative inside."""
        values = self.volume.features
        signed = 1 - 2 * values if self.is_occupancy else values.clamp(-1, 1)
        return self.volume.with_features(signed).to_grids()[0]

    def mesh(self, extent: float = 3.0) -> MeshArrays:
        """A closed mesh by marching cubes, in a cube of size `extent` metres."""
        return octree_surface(self.signed(), extent)


@dataclass(frozen=True, eq=False)
class Result:
    """One method on one model at one resolution."""

    row: Row
    field: Field


class Bench:
    """Runs the methods of a plan on models.

    Args:
        facts: what the manifest of the data set says.
        plan: the methods to run, and what they take.
        weight: TV-L1's.
        network: the network that `ours` runs; on its device, in evaluation mode.
        resolutions: resolutions that the network reads and the data set has.
        origins: gives the mesh that the surfaces are measured against, if it can.
    """

    def __init__(self, facts: DatasetFacts, plan: VariantPlan, weight: Weight, network: OctNetFusion | None,
                 resolutions: Sequence[int], origins: Origins) -> None:
        self._facts, self._plan, self._weight = facts, plan, weight
        self._network, self._resolutions, self._origins = network, resolutions, origins

    def run(self, model: Model) -> Iterator[Result]:
        """The results of all methods at all resolutions that the model was read at; first the truth's own.

        The ground truth is measured against the surface as a method is (`TRUTH`): what its resolution can
        hold of the true surface is the most that a method can reach.
        """
        truths = {resolution: Field(OctreeBatch.from_grids([truth]), self._facts.is_occupancy)
                  for resolution, truth in model.truths.items()}
        reference = self._reference(model, truths)
        seen = {resolution: self._seen(model, resolution) for resolution in truths}
        for resolution, truth in truths.items():
            row = self._row(model, TRUTH, truth, truth, math.nan, seen[resolution], reference)
            yield Result(row, truth)
        for method, encoding in self._plan.sources.items():
            for resolution, found, seconds in self._reconstruct(method, model.inputs[encoding], encoding):
                row = self._row(model, self._plan.label(method), found, truths[resolution], seconds,
                                seen[resolution], reference)
                yield Result(row, found)

    def _reference(self, model: Model, truths: Mapping[int, Field]) -> Reference:
        """The mesh's surface, or that of the finest ground truth."""
        extent = self._facts.extent
        longest = THICK * extent / min(truths)
        finest = truths[max(truths)].signed()
        if self._origins.available:
            return self._origins.reference(model, finest, longest)
        return Reference.of_truth(finest, extent, longest)

    def _seen(self, model: Model, resolution: int) -> OctreeBatch | None:
        encoding = self._plan.seen
        if encoding not in EXACT and self._origins.available:
            return self._origins.seen(model, self._plan.variant, resolution)
        if encoding is None:
            return None
        return seen_by(OctreeBatch.from_grids([model.inputs[encoding][resolution]]), encoding)

    def _reconstruct(self, method: Method, inputs: Mapping[int, GridOctree],
                     encoding: Encoding) -> Iterator[tuple[int, Field, float]]:
        if method is Method.OURS and self._network is not None:
            device = next(self._network.parameters()).device
            batches = [OctreeBatch.from_grids([inputs[resolution]]) for resolution in self._resolutions]
            is_occupancy = self._network.output is Output.OCCUPANCY
            levels = run_levels(self._network, batches, device)
            for resolution, reached in zip(self._resolutions, levels, strict=False):  # it may read one more
                yield resolution, Field(reached.reconstruction, is_occupancy), reached.seconds
            return
        for resolution, octree in inputs.items():
            start = time.perf_counter()
            if method is Method.TVL1:
                fused = tvl1(octree, self._weight(self._plan.variant, resolution))
                seconds = time.perf_counter() - start
            else:
                fused, seconds = stored_volfus(octree, encoding), math.nan
            yield resolution, Field(OctreeBatch.from_grids([fused]), False), seconds

    def _row(self, model: Model, label: str, result: Field, truth: Field, seconds: float,
             seen: OctreeBatch | None, reference: Reference) -> Row:
        resolution = max(truth.volume.shape)
        mad, known, regions = math.nan, math.nan, Regions()
        if result.is_occupancy or truth.is_occupancy:
            overlap = occupancy_overlap(result.as_occupancy(), truth.as_occupancy())
        else:
            structure = result.volume.structure.union(truth.volume.structure)
            if seen is not None:
                structure = structure.union(seen.structure)
            found, true = result.volume.refined(structure), truth.volume.refined(structure)  # once for all
            overlap = tsdf_overlap(found, true)
            mad = float(mad_mm(found, true, self._facts.taus[resolution]))
            known = float(known_mad_mm(found, true, self._facts.taus[resolution]))
            if seen is not None:
                regions = Regions(*mad_by_region(found, true, seen, self._facts.taus[resolution])[0].tolist())
        extent = self._facts.extent
        reached = Surface.of_octree(result.signed(), extent)
        surface = measure_surface(reached, reference, extent / resolution, extent)
        return Row(model.key, model.category, self._plan.variant, resolution, label, mad, float(overlap.iou),
                   float(overlap.precision), float(overlap.recall), seconds, result.volume.n_leaves, regions,
                   surface, known)


def level_resolutions(facts: DatasetFacts, network: OctNetFusion, resolutions: Sequence[int]) -> list[int]:
    """Resolutions that the network reads, coarse to fine, as far as the data set has them.

    Args:
        facts: what the manifest of the data set says.
        network: the network.
        resolutions: those of its levels, coarse to fine.

    Raises:
        OcnfError: it lacks that of the first level.
    """
    read = network.reads(resolutions)
    shared = list(takewhile(lambda resolution: resolution in facts.resolutions, read))
    if not shared:
        raise OcnfError("the data set lacks the resolution of the network's first level", code="missing",
                        where=facts.url, field="resolutions", found=list(facts.resolutions),
                        expected=read[0],
                        fix="generate it, or evaluate other methods")
    return shared
