"""The figures of a table's cells, from the models' figures that evaluation wrote."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from statistics import median

from ocnf_model.evaluation.intervals import Ratio, bootstrap_mean, bootstrap_ratio
from ocnf_model.tables.schema import Claim, Line, PaperRow, Quantity, TableSpec


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Attributes:
        ours: the figure here, with its 95 % interval over the models; NaN where there is none.
        paper: the paper's figure.
        models: the figure of each model, by its key.
    """

    ours: Ratio
    paper: float | None
    models: Mapping[str, float]


@dataclass(frozen=True)
class Reading:
    """A claim of the paper looked at in one row (or column).

    Attributes:
        claim: what the paper says.
        where: name of the row or column.
        less, than: what is compared.
        paper: the paper's ratio of the two; None where it has not both.
        ours: the ratio here, with its interval.
    """

    claim: str
    where: str
    less: str
    than: str
    paper: float | None
    ours: Ratio

    @property
    def verdict(self) -> str:
        """Whether the claim holds here, by the interval."""
        if math.isnan(self.ours.low):
            return "too few models"
        if self.ours.high < 1:
            return "holds"
        return "does not hold" if self.ours.low > 1 else "open"


class TableFigures:
    """Reads the figures of a table.

    Args:
        table: the table.
        models: gives the figure of each model for a row and a column; empty where there is none.
    """

    def __init__(self, table: TableSpec, models: Callable[[Line, Line], Mapping[str, float]]) -> None:
        self._table, self._models = table, models
        self.cells = [[self._cell(row, column, paper) for column, paper in zip(
            table.columns, row.paper, strict=True)] for row in table.rows]

    def readings(self) -> Iterator[Reading]:
        """Every claim of the paper in every row or column that it is about and that has figures here."""
        for claim in self._table.claims:
            lines, others = self._table.axes(claim)
            for other in others:
                if claim.only is None or other.name in claim.only:
                    for number, than in enumerate(claim.than):
                        reading = self._reading(claim, [line.name for line in lines],
                                                others.index(other), number, than)
                        if not math.isnan(reading.ours.value):
                            yield reading

    def _reading(self, claim: Claim, names: list[str], other: int, number: int, than: str) -> Reading:
        def cell(name: str) -> Cell:
            at = names.index(name)
            return self.cells[other][at] if claim.along == "columns" else self.cells[at][other]

        sides = [(claim.less, claim.less_from),
                 (than, claim.than_from[number] if claim.less_from is not None else None)]
        found: list[Mapping[str, float]] = []
        papers: list[float | None] = []
        for name, before in sides:
            one, start = cell(name), None if before is None else cell(before)
            found.append(one.models if start is None else
                         {key: value - start.models[key] for key, value in one.models.items()
                          if key in start.models})
            papers.append(one.paper if start is None or one.paper is None or start.paper is None
                          else one.paper - start.paper)
        shared = sorted(found[0].keys() & found[1].keys())
        ours = bootstrap_ratio([found[0][key] for key in shared], [found[1][key] for key in shared])
        paper = None if papers[0] is None or not papers[1] else papers[0] / papers[1]
        where = self._table.axes(claim)[1][other].name
        rise = "" if claim.less_from is None else "increase to "
        return Reading(claim.says, where, rise + claim.less, rise + than, paper, ours)

    def _cell(self, row: PaperRow, column: Line, paper: float | None) -> Cell:
        models = self._models(row, column)
        if self._table.quantity is Quantity.SECONDS:
            ours = Ratio(median(models.values())) if models else Ratio()
        else:
            ours = bootstrap_mean(list(models.values()))
        return Cell(ours, paper, models)
