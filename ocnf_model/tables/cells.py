"""The figures of a table's cells, from the models' figures that evaluation wrote."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors
from ocnf_model.evaluation.intervals import Ratio, bootstrap_mean, bootstrap_ratio
from ocnf_model.evaluation.methods import Method
from ocnf_model.tables.schema import Claim, Line, PaperRow, Quantity, TableSpec
from ocnf_model.tables.steps import Layout, input_of, network_of


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
        layout: where the evaluations lie.
    """

    def __init__(self, table: TableSpec, layout: Layout) -> None:
        self._table, self._layout = table, layout
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

    def _models(self, row: Line, column: Line) -> dict[str, float]:
        """The figure of each model; empty where the budget has no such level or the step is not done yet."""
        table, layout = self._table, self._layout
        variant, method = input_of(table, row, column), row.method or column.method
        level = row.level or column.level or len(layout.budget.resolutions)
        if variant is None or method is None or level > len(layout.budget.resolutions):
            return {}
        resolution = layout.budget.resolutions[level - 1]
        network = network_of(table, row, column)
        data = layout.data(variant, table.inputs[variant])
        run = None if network is None else layout.run(network, table.inputs[variant])
        folder = f"baselines/{data}" if run is None else f"networks/{run}"
        parts = [layout.out / folder / "models.csv"]
        is_time = table.quantity is Quantity.SECONDS
        parts += [layout.out / "times" / f"{data}.csv"] if is_time else []
        if not all(part.is_file() for part in parts):
            return {}
        category = row.category or column.category
        chosen = None if category is None else layout.budget.folder(category)
        found = {line["key"]: line["seconds" if is_time else "mad_mm"]
                 for line in _lines(parts[0])
                 if line["method"].rstrip("*") == method.label and int(line["resolution"]) == resolution
                 and chosen in (None, line["category"])}
        if not is_time:
            return {key: float(value) for key, value in found.items() if value}
        encoding = encoding_seconds(parts[1], method, resolution)
        return {key: float(value or 0) + encoding[key] for key, value in found.items() if key in encoding}


def encoding_seconds(path: Path, method: Method, resolution: int) -> dict[str, float]:
    """Seconds that a method's inputs take, by model.

    VolFus is its input; the network takes the inputs of all levels up to that of the resolution.
    """
    wanted = Encoding.TSDF if method is Method.VOLFUS else Encoding.HISTOGRAM
    found: dict[str, float] = {}
    for line in _lines(path):
        at = int(line["resolution"])
        counts = at <= resolution if method is Method.OURS else at == resolution
        if line["encoding"] == wanted and counts:
            found[line["key"]] = found.get(line["key"], 0.0) + float(line["seconds"])
    return found


def _lines(path: Path) -> list[dict[str, str]]:
    with storage_errors(path), path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    if not lines:
        raise OcnfError("a table without a line", code="damaged", where=path,
                        fix="delete it, and run the same command again")
    return lines
