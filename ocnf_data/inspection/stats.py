"""Leaf counts, band fractions and depth coverage of a data set by category: a table, and a plot.

*truth* and the inputs: the number of leaves as a share of the voxels; *band* the share of the volume with
|TSDF| < tau (which means decoding the ground truth, so by default only of a few samples a category);
*coverage* the share of the pixels of all views that hit the mesh. With `mad` also plain fusion's error: the
mean over all voxels of |TSDF of the noisy views - ground truth| in millimetres, for inputs stored as `tsdf`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.inspection.pictures import save_picture
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree
from ocnf_data.shards.browse import stored_samples
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.shards.tarformat import input_member, target_member
from ocnf_data.terminal import narrow_table

_ALL = "all"
Columns = dict[str, dict[str, list[float]]]


def band_fraction(octree: GridOctree) -> float:
    """Share of the volume with |value| < 1."""
    volume = octree.leaf_sizes().astype(np.float64) ** 3
    return float(volume[np.abs(octree.data[:, 0]) < 1].sum() / volume.sum())


def mean_absolute_difference(a: GridOctree, b: GridOctree) -> float:
    """Mean over all voxels of |a - b|, channel 0."""
    return float(np.abs(a.to_dense()[0] - b.to_dense()[0]).mean(dtype=np.float64))


def collect(url: str, split: str | None, band_samples: int, mad: bool = False) -> Columns:
    """Values in percent (MAD: millimetres) by column and category; `all` is every category together.

    Raises:
        OcnfError: the data set cannot be read, or has no sample of `split` (`empty`); with `mad` also if no
            input is stored as TSDF beside a TSDF ground truth.
    """
    info = load_dataset(url)
    manifest = Manifest.from_dict(info.manifest)
    fused = [v.name for v in manifest.inputs if Encoding.TSDF in v.encodings] if mad else []
    if mad and (not fused or manifest.target != "tsdf"):
        raise OcnfError("no input is stored as TSDF beside a TSDF target", where=url, field="--mad")
    members: list[tuple[str, Callable[[int], str]]] = [("truth", target_member)]
    members += [(f"{variant.name} {encoding}", partial(input_member, variant.name, encoding))
                for variant in manifest.inputs for encoding in variant.encodings]
    columns: Columns = defaultdict(lambda: defaultdict(list))

    def record(column: str, category: str, value: float) -> None:
        columns[column][category].append(value)
        columns[column][_ALL].append(value)

    console = Console(stderr=True)
    for sample in track(list(stored_samples(url, info)), "reading", console=console, transient=True):
        if split not in (None, sample.split):
            continue
        category = sample.entry.category
        record("coverage", category, 100 * sample.facts["coverage"])
        for label, name_of in members:
            for res in manifest.resolutions:
                leaves = sample.entry.leaf_counts[name_of(res)]
                record(f"{label} {res}³", category, 100 * leaves / res**3)
        finest = manifest.resolutions[-1]
        column = f"band {finest}³"
        if manifest.target == "tsdf" and len(columns[column][category]) < (band_samples or np.inf):
            record(column, category, 100 * band_fraction(sample.octree(target_member(finest))))
        for variant, res in product(fused, manifest.resolutions):
            error = mean_absolute_difference(sample.octree(input_member(variant, Encoding.TSDF, res)),
                                             sample.octree(target_member(res)))
            record(f"MAD mm, {variant} {res}³", category, 1000 * manifest.truncation(res) * error)
    if not columns:
        raise OcnfError("no samples", code="empty", where=url, field="split", found=split)
    return columns


def print_table(columns: Columns, console: Console) -> None:
    """One row a category, the means in percent; what differs in resolution alone shares a cell.

    Columns that do not fit into the console's width make a table of their own below.
    """
    grouped: dict[str, list[str]] = defaultdict(list)
    for name in columns:
        grouped[name.rpartition(" ")[0] or name].append(name)
    left = list(grouped)
    title = "means, in % of the voxels (coverage: of the pixels)"
    while left:
        shown = left
        while len(shown) > 1 and _width(_table(columns, grouped, shown, title), console) > console.width:
            shown = shown[:-1]
        console.print(_table(columns, grouped, shown, title))
        left, title = left[len(shown):], "continued"


def _width(table: Table, console: Console) -> int:
    """Characters that a table would take if there were room enough."""
    return console.measure(table, options=console.options.update(width=10_000)).maximum


def _table(columns: Columns, grouped: dict[str, list[str]], labels: list[str], title: str) -> Table:
    """The table of some of the groups of columns."""
    table = narrow_table(title)
    table.add_column("category", no_wrap=True)
    table.add_column("n", justify="right", no_wrap=True)
    for label in labels:
        resolutions = "/".join(name.removeprefix(label).strip() for name in grouped[label])
        table.add_column(f"{label}\n{resolutions}", justify="right", no_wrap=True)
    categories = [*sorted(set(columns["coverage"]) - {_ALL}), _ALL]
    for category in categories:
        cells = ("/".join(_mean(columns[name][category]) for name in grouped[label]) for label in labels)
        n_samples = str(len(columns["coverage"][category]))
        table.add_row(escape(category), n_samples, *cells, end_section=category == categories[-2])
    return table


def _mean(values: list[float]) -> str:
    return f"{np.mean(values):.3g}" if values else "-"


def draw(columns: Columns, path: Path) -> None:
    """A box plot a column, by category.

    Raises:
        OcnfError: matplotlib is not installed (`missing_extra`), or the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("the plot needs matplotlib", "generate") from error

    categories = sorted(set(columns["coverage"]) - {_ALL})
    across = min(3, len(columns))
    down = -(-len(columns) // across)
    size = (5.2 * across, 0.9 + down * (1 + 0.28 * len(categories)))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(down, across, squeeze=False)
    for ax, (name, values) in zip(axes.flat, columns.items(), strict=False):
        ax.boxplot([values[c] for c in categories], orientation="horizontal",
                   tick_labels=categories, widths=0.6, medianprops={"color": "#1f6fb2"})
        ax.set_title(name if name.startswith("MAD") else f"{name}, %", fontsize=10)
        ax.set_xlim(left=0)
        ax.invert_yaxis()
        ax.grid(axis="x", alpha=0.3)
    for ax in axes.flat[len(columns):]:
        ax.set_axis_off()
    save_picture(figure, path)
