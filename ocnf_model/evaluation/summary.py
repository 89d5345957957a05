"""Means of the figures over models, and figures as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, TypeVar

import numpy as np

from ocnf_model.evaluation.intervals import Ratio, bootstrap_ratio
from ocnf_model.evaluation.measure import Row
from ocnf_model.measures.figures import SurfaceFigures
from ocnf_model.measures.regions import Regions

ALL = "all"
_PREFIXES = {"regions": "mad_", "ratio": "ratio_"}  # of a part's fields in CSV; none for others

Figures = TypeVar("Figures", Regions, SurfaceFigures)


@dataclass(frozen=True)
class Summary:
    """The mean over the models of a variant, category, resolution and method.

    Attributes:
        category: `all` for the mean over all models, whatever their category; that of a category with this
            name is `all (category)`.
        n_models: number of models.
        mad_mm, iou, precision, recall: means of the fields of `Row` with these names.
        seconds: the median, which a first call that compiles does not move; NaN where nothing ran.
        ratio: the MAD divided by VolFus's on the same models, with its interval; NaN where either is not
            known.
        regions: contributions to the MAD.
        surface: measures of the surface; each recall by thickness is the mean over the models that have such
            parts.
        n_thin, n_medium, n_thick: models that have such parts.
        known_mm: mean of the field of `Row` with this name over the models that have it.
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
    ratio: Ratio = field(default_factory=Ratio)
    regions: Regions = field(default_factory=Regions)
    surface: SurfaceFigures = field(default_factory=SurfaceFigures)
    n_thin: int = 0
    n_medium: int = 0
    n_thick: int = 0
    known_mm: float = math.nan


def summarise(rows: Iterable[Row]) -> list[Summary]:
    """The means, `all` first, then the categories by name; methods in the order in which they were met."""
    groups: dict[tuple[str, str, int, str], list[Row]] = {}
    for row in rows:
        own = f"{ALL} (category)" if row.category == ALL else row.category
        for category in (ALL, own):
            groups.setdefault((row.variant, category, row.resolution, row.method), []).append(row)
    order = list(dict.fromkeys(method for *_, method in groups))
    variants = list(dict.fromkeys(variant for variant, *_ in groups))
    ranked = sorted(groups, key=lambda group: (variants.index(group[0]), group[1] != ALL, group[1], group[2],
                                               order.index(group[3])))
    volfus = {group[:3]: found for group, found in groups.items() if group[3].startswith("VolFus")}
    return [_summary(group, groups[group], volfus.get(group[:3], ())) for group in ranked]


def _summary(group: tuple[str, str, int, str], rows: Sequence[Row], volfus: Sequence[Row]) -> Summary:
    mad_mm, iou, precision, recall = np.mean(
        [(row.mad_mm, row.iou, row.precision, row.recall) for row in rows], axis=0).tolist()
    seconds = float(np.median([row.seconds for row in rows]))
    theirs = {row.key: row.mad_mm for row in volfus}
    surfaces = [row.surface for row in rows]
    return Summary(
        *group, len(rows), mad_mm, iou, precision, recall, seconds,
        ratio=bootstrap_ratio([row.mad_mm for row in rows],
                              [theirs.get(row.key, math.nan) for row in rows]),
        regions=_mean(Regions, [row.regions for row in rows]), surface=_mean(SurfaceFigures, surfaces),
        n_thin=_known(one.recall_thin for one in surfaces),
        n_medium=_known(one.recall_medium for one in surfaces),
        n_thick=_known(one.recall_thick for one in surfaces), known_mm=_mean_known(rows))


def _mean_known(rows: Sequence[Row]) -> float:
    known = [row.known_mm for row in rows if not math.isnan(row.known_mm)]
    return float(np.mean(known)) if known else math.nan


def _mean(kind: type[Figures], parts: Sequence[Figures]) -> Figures:
    """The mean of each field over those parts that have it."""
    means = {}
    for one in fields(kind):
        known = [value for value in (getattr(part, one.name) for part in parts) if not math.isnan(value)]
        means[one.name] = float(np.mean(known)) if known else math.nan
    return kind(**means)


def _known(values: Iterable[float]) -> int:
    return sum(not math.isnan(value) for value in values)


def to_csv(records: Sequence[Row] | Sequence[Summary]) -> str:
    """A line a record, under the names of its fields; what is not known is empty.

    The contributions of the regions are `mad_seen_free` and so on, the ratio is `ratio_value`, `ratio_low`
    and `ratio_high`.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, [name for name, _ in _flat(records[0])], lineterminator="\n")
    writer.writeheader()
    for record in records:
        writer.writerow({name: "" if isinstance(value, float) and math.isnan(value) else value
                         for name, value in _flat(record)})
    return text.getvalue()


def _flat(record: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The fields of a record and of its parts."""
    for one in fields(record):
        value = getattr(record, one.name)
        if is_dataclass(value):
            yield from _flat(value, _PREFIXES.get(one.name, ""))
        else:
            yield prefix + one.name, value
