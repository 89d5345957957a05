"""What a level makes of the validation samples: mean errors, where they lie, the surface, and a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass

import torch

from ocnf_data.arrays import U8
from ocnf_data.encodings import Encoding
from ocnf_data.octree import GridOctree
from ocnf_model.measures.figures import f_score
from ocnf_model.measures.regions import Regions, mad_by_region, seen_by
from ocnf_model.measures.surface import Surface
from ocnf_model.metrics import mad_mm, occupancy_mad, occupancy_overlap, tsdf_overlap
from ocnf_model.network import Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.training.batches import Example
from ocnf_model.training.pictures import draw_slices

_PICTURED = 4  # samples


@dataclass(frozen=True, eq=False)
class Validation:
    """Means over the validation samples.

    Attributes:
        mad: millimetres, or for occupancy the mean difference of probabilities.
        iou: intersection over union of the occupied voxels, 0 to 1.
        f_score: F-score of the surface at one voxel, 0 to 1, against the ground truth's surface at the
            level's resolution.
        regions: contributions to the MAD; NaN for occupancy, and where the encoding does not tell what is
            seen.
        picture: (H, W, 3) slices through the first samples of this process; None without any.
    """

    mad: float
    iou: float
    f_score: float
    regions: Regions
    picture: U8 | None


class Validator:
    """Measures predictions of a level.

    Args:
        output: what the network makes.
        encoding: encoding of the inputs.
        tau: truncation distance at the level's resolution, in metres.
    """

    def __init__(self, output: Output, encoding: Encoding, tau: float) -> None:
        self._output, self._encoding = output, encoding
        self._tau = tau
        self._sums = torch.zeros(10, dtype=torch.float64)
        self._rows: list[tuple[GridOctree, GridOctree, GridOctree]] = []

    @torch.no_grad()
    def add(self, prediction: OctreeBatch, example: Example) -> None:
        """Measure a batch.

        Args:
            prediction: the level's reconstruction of the example, in float32.
            example: inputs and ground truth.
        """
        is_tsdf = self._output is Output.TSDF
        overlap = tsdf_overlap if is_tsdf else occupancy_overlap
        encoded = example.encoded
        seen = seen_by(encoded, self._encoding) if is_tsdf else None
        mads = mad_mm(prediction, example.target, self._tau) if is_tsdf \
            else occupancy_mad(prediction, example.target)
        regions = torch.full((len(mads), 6), torch.nan, dtype=torch.float64)
        if seen is not None:
            regions = mad_by_region(prediction, example.target, seen, self._tau).cpu()
        found, true = ([self._signed(grid) for grid in batch.to_grids()]
                       for batch in (prediction, example.target))
        scores = [_f_score(*pair) for pair in zip(found, true, strict=True)]
        columns = torch.stack([mads.cpu(), overlap(prediction, example.target).iou.cpu(),
                               torch.tensor(scores, dtype=torch.float64)], dim=1)
        self._sums[:3] += columns.sum(0)
        self._sums[3:9] += regions.sum(0)
        self._sums[9] += len(mads)
        if len(self._rows) < _PICTURED:
            self._rows += zip(encoded.to_grids(), found, true, strict=True)

    def means(self, total: Callable[[list[float]], list[float]]) -> Validation | None:
        """The means over the samples of all processes; None where there are none.

        Args:
            total: sums over the processes.
        """
        *sums, count = total(self._sums.tolist())
        if not count:
            return None
        mad, iou, score, *regions = (value / count for value in sums)
        picture = draw_slices(self._rows[:_PICTURED], self._encoding) if self._rows else None
        return Validation(mad, iou, score, Regions(*regions), picture)

    def _signed(self, grid: GridOctree) -> GridOctree:
        """The octree with signed values in [-1, 1], negative inside."""
        values = grid.data if self._output is Output.TSDF else 1 - 2 * grid.data  # unknown ones become free
        return grid.with_data(values.clip(-1, 1))


def _f_score(found: GridOctree, true: GridOctree) -> float:
    """F-score at a distance of one voxel; lengths are in voxels here."""
    size = float(max(true.shape))
    return f_score(Surface.of_octree(found, size), Surface.of_octree(true, size), 1.0)


def region_scalars(regions: Regions) -> Iterable[tuple[str, float]]:
    """Name and contribution of each region that is known."""
    names = Regions.__dataclass_fields__
    return [(name, value) for name, value in zip(names, astuple(regions), strict=True) if value == value]
