"""A table in the paper's layout as Markdown, CSV and LaTeX, the paper's figures beside ours."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from itertools import groupby

from ocnf_model.tables.cells import Cell, Reading
from ocnf_model.tables.schema import Line, Quantity, TableSpec

_NONE = "–"
_LATEX = {"³": r"$^3$", "σ": r"$\sigma$", "%": r"\%", "&": r"\&", "_": r"\_", "–": "--"}

Cells = Sequence[Sequence[Cell]]


def best_cells(table: TableSpec, cells: Cells) -> set[tuple[int, int]]:
    """(row, column) of the best figure of every row, among the columns of a group."""
    found = set()
    more_is_better = table.quantity is Quantity.OVERLAP
    for i, row in enumerate(cells):
        groups: dict[str | None, list[int]] = {}
        for j, column in enumerate(table.columns):
            if not math.isnan(row[j].ours.value):
                groups.setdefault(column.group, []).append(j)
        if not more_is_better:
            found |= {(i, min(group, key=lambda j: row[j].ours.value)) for group in groups.values()}
    if more_is_better:
        for j in range(len(table.columns)):
            known = [i for i, row in enumerate(cells) if not math.isnan(row[j].ours.value)]
            found |= {(max(known, key=lambda i: cells[i][j].ours.value), j)} if known else set()
    return found


def to_markdown(table: TableSpec, cells: Cells, readings: Sequence[Reading], above: Sequence[str]) -> str:
    """What differs, the table, its intervals, and what the paper reads out of it."""
    unit = f", {table.unit}" if table.unit else ""
    best = best_cells(table, cells)
    head = [table.corner, *(column.name for column in table.columns)]
    both, intervals = [], []
    for i, row in enumerate(table.rows):
        texts = []
        for j, cell in enumerate(cells[i]):
            ours = figure_text(cell.ours.value, table.digits)
            bold = f"**{ours}**" if (i, j) in best else ours
            texts.append(f"{bold} / {figure_text(cell.paper, table.digits)}")
        both.append([row.name, *texts])
        intervals.append([row.name, *(interval(cell, table.digits) for cell in cells[i])])
    parts = [f"# {table.title}", "\n".join(f"- {sentence}" for sentence in above),
             f"Here / in the paper{unit}; the best here in bold.", _grid(head, both)]
    if any(cell.ours.low == cell.ours.low for row in cells for cell in row):
        parts += [f"95 % intervals over the models (bootstrap){unit}:", _grid(head, intervals)]
    if readings:
        lines = [[one.claim, one.where, f"{one.less} to {one.than}", figure_text(one.paper, 2),
                  f"{one.ours.value:.2f}" + (f" [{one.ours.low:.2f}, {one.ours.high:.2f}]"
                                             if one.ours.low == one.ours.low else ""), one.verdict]
                 for one in readings]
        parts += ["What the paper reads out of it, as ratios over the same models: below 1 the claim holds. "
                  "It is open where the interval has 1 in it.",
                  _grid(["claim", "where", "ratio of", "paper", "here", ""], lines)]
    return "\n\n".join(parts) + "\n"


def to_table_csv(table: TableSpec, cells: Cells) -> str:
    """The paper's layout, with four columns for each: ours, the interval's ends, the paper's figure."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([table.corner, *(f"{column.name}{what}" for column in table.columns
                                     for what in ("", " low", " high", " paper", " models"))])
    for row, line in zip(table.rows, cells, strict=True):
        writer.writerow([row.name, *(_plain(value) for cell in line for value in (
            cell.ours.value, cell.ours.low, cell.ours.high, cell.paper, len(cell.models)))])
    return text.getvalue()


def to_latex(table: TableSpec, cells: Cells, above: Sequence[str]) -> str:
    r"""A booktabs `tabular` in the paper's layout, the paper's figure in brackets behind ours."""
    best = best_cells(table, cells)
    grouped = any(row.group for row in table.rows)
    first = 2 if grouped else 1
    alignment = "l" * first + "c" * len(table.columns)
    lines = [*(f"% {sentence}" for sentence in above), rf"\begin{{tabular}}{{{alignment}}}", r"\toprule"]
    if any(column.group for column in table.columns):
        lines += _group_heads(table.columns, first)
    corner = latex_text(table.corner) + (" &" if grouped else "")
    lines.append(f"{corner} & {' & '.join(map(_heading, table.columns))} \\\\ \\midrule")
    by_group = groupby(enumerate(table.rows), lambda one: one[1].group)
    for nth, (group, members) in enumerate(by_group):
        rows = list(members)
        if nth:
            lines[-1] += r" \midrule"
        for place, (i, row) in enumerate(rows):
            texts = [_latex_cell(cell, table.digits, (i, j) in best) for j, cell in enumerate(cells[i])]
            start = ""
            if grouped:
                title = rf"\multirow{{{len(rows)}}}{{*}}{{{latex_text(group or '')}}}"
                start = " & " if place else f"{title} & "
            lines.append(f"{start}{_heading(row)} & {' & '.join(texts)} \\\\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"


def figure_text(value: float | None, digits: int) -> str:
    """A figure's text; a dash where there is none."""
    return _NONE if value is None or math.isnan(value) else f"{value:.{digits}f}"


def interval(cell: Cell, digits: int) -> str:
    """The text of a cell's interval."""
    if math.isnan(cell.ours.low):
        return _NONE
    return f"{cell.ours.low:.{digits}f} to {cell.ours.high:.{digits}f}"


def latex_text(text: str) -> str:
    """Plain text for LaTeX."""
    return "".join(_LATEX.get(letter, letter) for letter in text)


def _heading(line: Line) -> str:
    return line.latex or latex_text(line.label)


def _group_heads(columns: Sequence[Line], first: int) -> list[str]:
    heads, rules, at = [], [], first + 1
    for _, members in groupby(columns, lambda column: column.group):
        group = list(members)
        title = group[0].group_latex or latex_text(group[0].group or "")
        heads.append(rf"\multicolumn{{{len(group)}}}{{c}}{{{title}}}")
        rules.append(rf"\cmidrule(lr){{{at}-{at + len(group) - 1}}}")
        at += len(group)
    return [" & " * first + " & ".join(heads) + r" \\ " + " ".join(rules)]


def _latex_cell(cell: Cell, digits: int, is_best: bool) -> str:
    ours = figure_text(cell.ours.value, digits)
    ours = latex_text(ours) if ours == _NONE else (rf"$\textbf{{{ours}}}$" if is_best else f"${ours}$")
    return ours if cell.paper is None else f"{ours} ({cell.paper:.{digits}f})"


def _grid(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [list(head), ["---", *["---:"] * (len(head) - 1)], *map(list, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _plain(value: float | None) -> float | str | int:
    return "" if value is None or math.isnan(value) else value
