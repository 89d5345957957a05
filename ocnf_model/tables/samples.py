"""The tables that are made of data sets of samples: where the figures of their cells lie."""

from __future__ import annotations

import csv
from pathlib import Path

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors
from ocnf_model.evaluation.methods import Method
from ocnf_model.tables.schema import Line, Quantity, TableSpec
from ocnf_model.tables.steps import Layout, input_of, network_of


def sample_figures(table: TableSpec, layout: Layout, row: Line, column: Line) -> dict[str, float]:
    """The figure of each model; empty where the budget has no such level, or the step is not done yet.

    Args:
        table: the table.
        layout: where the evaluations lie.
        row: a row of the table.
        column: a column of it.
    """
    variant, method = input_of(table, row, column), row.method or column.method
    level = row.level or column.level or len(layout.budget.resolutions)
    if variant is None or method is None or level > len(layout.budget.resolutions):
        return {}
    resolution = layout.budget.resolutions[level - 1]
    network = network_of(table, row, column)
    data = layout.data(variant, table.inputs[variant])
    run = None if network is None else layout.run(network, table.inputs[variant])
    made = f"baselines/{layout.weighed(data)}" if run is None else f"networks/{run}"
    parts = [layout.out / made / "models.csv"]
    is_time = table.quantity is Quantity.SECONDS
    parts += [layout.out / "times" / f"{data}.csv"] if is_time else []
    if not all(part.is_file() for part in parts):
        return {}
    category = row.category or column.category
    chosen = None if category is None else layout.budget.folder(category)
    found = {line["key"]: line["seconds" if is_time else "mad_mm"] for line in read_lines(parts[0])
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
    for line in read_lines(path):
        at = int(line["resolution"])
        counts = at <= resolution if method is Method.OURS else at == resolution
        if line["encoding"] == wanted and counts:
            found[line["key"]] = found.get(line["key"], 0.0) + float(line["seconds"])
    return found


def read_lines(path: Path) -> list[dict[str, str]]:
    """The lines of a CSV file, by the names of its columns.

    Raises:
        OcnfError: the file cannot be read, or has no line below its head (`damaged`).
    """
    with storage_errors(path), path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    if not lines:
        raise OcnfError("a table without a line", code="damaged", where=path,
                        fix="delete it, and run the same command again")
    return lines
