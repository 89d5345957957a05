"""The tables of regions, surfaces and thin parts: their columns and legends."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass

from ocnf_model.evaluation.summary import Summary


@dataclass(frozen=True)
class Table:
    """A table of figures, a line a resolution and method.

    Attributes:
        title: title of the table.
        head: headings of the columns after grid and method.
        cells: makes the cells of a line out of a summary.
        legend: text below the table.
        with_ceilings: whether the ground truth has a line too.
    """

    title: str
    head: tuple[str, ...]
    cells: Callable[[Summary], list[str]]
    legend: str
    with_ceilings: bool

    def lines(self, summaries: Sequence[Summary], ceilings: Sequence[Summary]) -> list[list[str]]:
        """The lines of one variant and category that have any figure."""
        chosen = [*summaries, *(ceilings if self.with_ceilings else ())]
        rows = [[f"{one.resolution}³", one.method, *self.cells(one)]
                for one in sorted(chosen, key=lambda one: one.resolution)]
        return [row for row in rows if any(row[2:])]


def _region_cells(one: Summary) -> list[str]:
    return [number(value, 3) for value in (*astuple(one.regions), one.regions.total, one.known_mm)]


def _surface_cells(one: Summary) -> list[str]:
    surface = one.surface
    return [number(surface.chamfer_mm, 2), number(surface.chamfer_voxels, 3), *(
        number(value, 3) for value in (surface.f_score, surface.surface_precision, surface.surface_recall,
                                        surface.normal_consistency))]


def _thin_cells(one: Summary) -> list[str]:
    surface = one.surface
    return [text for value, n in ((surface.recall_thin, one.n_thin), (surface.recall_medium, one.n_medium),
                                  (surface.recall_thick, one.n_thick))
            for text in ((number(value, 3), str(n)) if n else ("", ""))]


TABLES = (
    Table("MAD by region, mm",
          ("seen free", "seen band", "seen inside", "unseen free", "unseen band", "unseen inside", "all",
           "known"),
          _region_cells,
          "Contributions to the MAD of the voxels that at least one input view counts for (seen) or none, by "
          "what the truth is there: free (+tau), inside (-tau, of scans also unknown), or the band between. "
          "They sum to the MAD. Known: the MAD over the voxels that are free or in the band alone.",
          with_ceilings=False),
    Table("surface", ("Chamfer mm", "Chamfer voxels", "F-score", "precision", "recall", "normals"),
          _surface_cells,
          "Chamfer: mean distance from samples of either surface to the other, averaged. F-score: harmonic "
          "mean of the shares within one voxel, of the reconstruction (precision) and of the truth (recall)."
          " Normals: mean |cosine| between the two. A ground truth's line: what its resolution can hold.",
          with_ceilings=True),
    Table("surface recall by thickness",
          ("below 1.5", "models", "1.5 to 3", "models", "3 and more", "models"), _thin_cells,
          "Share of the true surface within one voxel of the reconstructed one, by the local thickness of "
          "the truth in voxels of the resolution: means over the models that have such parts.",
          with_ceilings=True),
)


def number(value: float, digits: int) -> str:
    """The text of a number in a table, empty for NaN."""
    return "" if math.isnan(value) else f"{value:.{digits}f}"
