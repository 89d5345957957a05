"""The figures of an evaluation as tables: in the terminal, Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import zip_longest

import numpy as np
from rich.console import Console

from ocnf_data.terminal import narrow_table
from ocnf_model.evaluation.measure import Row

ALL = "all"
_HEAD = ("grid", "method", "MAD mm", "/ VolFus", "IoU", "precision", "recall", "seconds", "models")


@dataclass(frozen=True)
class Summary:
    """The mean over the models of a variant, category, resolution and method.

    Attributes:
        category: `all` for the mean over all models, whatever their category.
        n_models: how many.
        seconds: the median, which a first call that compiles does not move; NaN where nothing ran.
    """

    variant: str
    category: str
    resolution: int
    method: str
    n_models: int
    mad_mm: float
    iou: float
    precision: float
    recall: float
    seconds: float


def summarise(rows: Iterable[Row]) -> list[Summary]:
    """The means, `all` first, then the categories by name; methods in the order in which they were met."""
    groups: dict[tuple[str, str, int, str], list[Row]] = {}
    for row in rows:
        for category in (ALL, row.category):
            groups.setdefault((row.variant, category, row.resolution, row.method), []).append(row)
    order = list(dict.fromkeys(method for *_, method in groups))
    variants = list(dict.fromkeys(variant for variant, *_ in groups))
    ranked = sorted(groups, key=lambda group: (variants.index(group[0]), group[1] != ALL, group[1], group[2],
                                               order.index(group[3])))
    return [_summary(group, groups[group]) for group in ranked]


def _summary(group: tuple[str, str, int, str], rows: Sequence[Row]) -> Summary:
    mad_mm, iou, precision, recall = np.mean(
        [(row.mad_mm, row.iou, row.precision, row.recall) for row in rows], axis=0).tolist()
    seconds = float(np.median([row.seconds for row in rows]))
    return Summary(*group, len(rows), mad_mm, iou, precision, recall, seconds)


def _lines(summaries: Sequence[Summary], variant: str, category: str) -> list[list[str]]:
    """The rows of a table: one a resolution and method."""
    chosen = [one for one in summaries if (one.variant, one.category) == (variant, category)]
    volfus = {one.resolution: one.mad_mm for one in chosen if one.method.startswith("VolFus")}
    return [[f"{one.resolution}³", one.method, _number(one.mad_mm, 3),
             _number(one.mad_mm / (volfus.get(one.resolution) or math.nan), 2), _number(one.iou, 3),
             _number(one.precision, 3), _number(one.recall, 3), _number(one.seconds, 2), str(one.n_models)]
            for one in chosen]


def _by_category(summaries: Sequence[Summary], variant: str) -> tuple[list[str], list[list[str]]]:
    """Head and rows of MAD (IoU where there is none) by category: a column a resolution and method."""
    chosen = [one for one in summaries if one.variant == variant]
    columns = list(dict.fromkeys((one.resolution, one.method) for one in chosen))
    cells = {(one.category, one.resolution, one.method): _number(one.mad_mm, 3) or _number(one.iou, 3)
             for one in chosen}
    categories = [*sorted({one.category for one in chosen} - {ALL}), ALL]
    return (["category", *(f"{method} {resolution}³" for resolution, method in columns)],
            [[category, *(cells.get((category, *column), "") for column in columns)]
             for category in categories])


def print_tables(console: Console, summaries: Sequence[Summary], notes: Sequence[str]) -> None:
    """Show the means in the terminal."""
    for variant in dict.fromkeys(one.variant for one in summaries):
        lines = _lines(summaries, variant, ALL)
        table = narrow_table(f"{variant}: mean over all models")
        for number, title in enumerate(_HEAD):
            table.add_column(title, justify="left" if number < 2 else "right", no_wrap=True)
        for cells, following in zip_longest(lines, lines[1:], fillvalue=lines[-1]):
            table.add_row(*cells, end_section=following[0] != cells[0])
        console.print(table)
        head, lines = _by_category(summaries, variant)
        table = narrow_table(f"{variant}: {_what(summaries, variant)} by category")
        for number, title in enumerate(head):
            table.add_column(title.replace(" ", "\n"), justify="right" if number else "left", no_wrap=True)
        for cells in lines:
            table.add_row(*cells)
        console.print(table)
    for note in notes:
        console.print(f"Note: {note}.", highlight=False)


def markdown(summaries: Sequence[Summary], title: str, notes: Sequence[str]) -> str:
    """The tables of `print_tables` as Markdown."""
    parts = [f"# {title}",
             "MAD is the mean |TSDF - ground truth| over all voxels of the cube, in millimetres. Figures are "
             "means over the models, of runtime the median; VolFus is in the data set and is not run."]
    for variant in dict.fromkeys(one.variant for one in summaries):
        parts += [f"## {variant}: all models", _table(_HEAD, _lines(summaries, variant, ALL)),
                  f"## {variant}: {_what(summaries, variant)} by category",
                  _table(*_by_category(summaries, variant))]
        for category in sorted({one.category for one in summaries if one.variant == variant} - {ALL}):
            parts += [f"### {variant}: {category}", _table(_HEAD, _lines(summaries, variant, category))]
    parts += [f"- {note}." for note in notes]
    return "\n\n".join(parts) + "\n"


def to_csv(records: Sequence[Row] | Sequence[Summary]) -> str:
    """A line a record, under the names of its fields; what is not known is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(records[0])], lineterminator="\n")
    writer.writeheader()
    for record in records:
        writer.writerow({name: "" if isinstance(value, float) and math.isnan(value) else value
                         for name, value in asdict(record).items()})
    return text.getvalue()


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(cells).replace("*", "\\*") + " |" for cells in (head, rule, *lines))


def _what(summaries: Sequence[Summary], variant: str) -> str:
    known = any(not math.isnan(one.mad_mm) for one in summaries if one.variant == variant)
    return "MAD in mm" if known else "IoU"


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"
