"""The figures of an evaluation as tables: in the terminal and in Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest

from rich.console import Console

from ocnf_data.terminal import narrow_table
from ocnf_model.evaluation.columns import TABLES, Table, number
from ocnf_model.evaluation.summary import ALL, Summary

_HEAD = ("grid", "method", "MAD mm", "/ VolFus", "IoU", "precision", "recall", "seconds", "models")


def _lines(summaries: Sequence[Summary], variant: str, category: str) -> list[list[str]]:
    """The rows of a table: one a resolution and method."""
    chosen = [one for one in summaries if (one.variant, one.category) == (variant, category)]
    return [[f"{one.resolution}³", one.method, number(one.mad_mm, 3),
             number(one.ratio.value, 2), number(one.iou, 3),
             number(one.precision, 3), number(one.recall, 3), number(one.seconds, 2), str(one.n_models)]
            for one in chosen]


def _by_category(summaries: Sequence[Summary], variant: str) -> tuple[list[str], list[list[str]]]:
    """Head and rows of MAD (IoU where no method has any) by category: a column a resolution and method."""
    chosen = [one for one in summaries if one.variant == variant]
    columns = list(dict.fromkeys((one.resolution, one.method) for one in chosen))
    in_mm = _has_mad(chosen)
    cells = {(one.category, one.resolution, one.method): number(one.mad_mm if in_mm else one.iou, 3)
             for one in chosen}
    categories = [*sorted({one.category for one in chosen} - {ALL}), ALL]
    return (["category", *(f"{method} {resolution}³" for resolution, method in columns)],
            [[category, *(cells.get((category, *column), "") for column in columns)]
             for category in categories])


def print_tables(console: Console, summaries: Sequence[Summary], notes: Sequence[str],
                 ceilings: Sequence[Summary] = ()) -> None:
    """Show the means in the terminal, in 80 columns."""
    for variant in dict.fromkeys(one.variant for one in summaries):
        lines = _lines(summaries, variant, ALL)
        _print_lines(console, f"{variant}: mean over all models", _HEAD, lines, flat=True)
        for interval in _intervals(summaries, variant):
            console.print(interval, highlight=False)
        for table, lines in _measured(summaries, ceilings, variant, ALL):
            head = "grid", "method", *table.head
            _print_lines(console, f"{variant}: {table.title}", head, lines, flat=False)
            console.print(table.legend, highlight=False)
        columns, lines = _by_category(summaries, variant)
        shown = narrow_table(f"{variant}: {_what(summaries, variant)} by category")
        for column, title in enumerate(columns):
            shown.add_column(title.replace(" ", "\n"), justify="right" if column else "left", no_wrap=True)
        for cells in lines:
            shown.add_row(*cells)
        console.print(shown)
    for note in notes:
        console.print(f"Note: {note}.", highlight=False)


def _print_lines(console: Console, title: str, head: Sequence[str], lines: Sequence[Sequence[str]],
                 flat: bool) -> None:
    """A table with a rule between resolutions; a head of two words stands in two lines, if not `flat`."""
    shown = narrow_table(title)
    for column, name in enumerate(head):
        shown.add_column(name if flat else name.replace(" ", "\n", 1),
                         justify="left" if column < 2 else "right", no_wrap=True)
    for cells, following in zip_longest(lines, lines[1:], fillvalue=lines[-1]):
        shown.add_row(*cells, end_section=following[0] != cells[0])
    console.print(shown)


def markdown(summaries: Sequence[Summary], title: str, notes: Sequence[str],
             ceilings: Sequence[Summary] = ()) -> str:
    """The tables of the means as Markdown."""
    parts = [f"# {title}",
             "MAD is the mean |TSDF - ground truth| over all voxels of the cube, in millimetres. Figures are "
             "means over the models, of runtime the median; VolFus is in the data set and is not run."]
    for variant in dict.fromkeys(one.variant for one in summaries):
        parts += [f"## {variant}: all models", _table(_HEAD, _lines(summaries, variant, ALL)),
                  *_intervals(summaries, variant)]
        for table, lines in _measured(summaries, ceilings, variant, ALL):
            parts += [f"## {variant}: {table.title}", _table(("grid", "method", *table.head), lines),
                      table.legend]
        parts += [f"## {variant}: {_what(summaries, variant)} by category",
                  _table(*_by_category(summaries, variant))]
        for category in sorted({one.category for one in summaries if one.variant == variant} - {ALL}):
            parts += [f"### {variant}: {category}", _table(_HEAD, _lines(summaries, variant, category))]
            for table, lines in _measured(summaries, ceilings, variant, category):
                parts += [f"#### {variant}: {category}, {table.title}",
                          _table(("grid", "method", *table.head), lines)]
    parts += [f"- {note}." for note in notes]
    return "\n\n".join(parts) + "\n"


def _measured(summaries: Sequence[Summary], ceilings: Sequence[Summary], variant: str,
              category: str) -> list[tuple[Table, list[list[str]]]]:
    """The tables of regions and surfaces that have any figures, with their lines."""
    mine, theirs = ([one for one in some if (one.variant, one.category) == (variant, category)]
                    for some in (summaries, ceilings))
    found = [(table, table.lines(mine, theirs)) for table in TABLES]
    return [(table, lines) for table, lines in found if lines]


def _intervals(summaries: Sequence[Summary], variant: str) -> list[str]:
    """A sentence on how sure the ratios to VolFus are, if there are any."""
    known = [f"{one.method} at {one.resolution}³ {one.ratio.value:.2f} ({one.ratio.low:.2f} to "
             f"{one.ratio.high:.2f})"
             for one in summaries if (one.variant, one.category) == (variant, ALL)
             and not one.method.startswith("VolFus") and not math.isnan(one.ratio.low)]
    return ["Ratio to VolFus, with 95 % intervals by bootstrap over the models: " + "; ".join(known) + "."] \
        if known else []


def _table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rule = ["---", *["---:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(cells).replace("*", "\\*") + " |" for cells in (head, rule, *lines))


def _what(summaries: Sequence[Summary], variant: str) -> str:
    return "MAD in mm" if _has_mad([one for one in summaries if one.variant == variant]) else "IoU"


def _has_mad(summaries: Sequence[Summary]) -> bool:
    return any(not math.isnan(one.mad_mm) for one in summaries)
