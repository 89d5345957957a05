"""What a data set's page says beside its samples: facts, tables, failures, provenance."""

from __future__ import annotations

import json
from collections import defaultdict

import numpy as np
import yaml

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.manifest import Manifest
from ocnf_data.report.contents import Card
from ocnf_data.report.page import Page, PageTable
from ocnf_data.report.sample import COLUMNS, Choice, page_scale
from ocnf_data.shards.dataset import FAILURES, DatasetInfo
from ocnf_data.verify.summary import DatasetSummary, describe, fingerprint_lines

_MAX_FAILURES = 64 * 2**20  # bytes of failures.jsonl


def data_page(store: Store, info: DatasetInfo, manifest: Manifest, choice: Choice, cards: list[Card],
              unshown: list[tuple[str, OcnfError]]) -> Page:
    """The page of a data set.

    Args:
        store: the data set's folder.
        info: its `dataset.json`.
        manifest: the manifest in it.
        choice: what is shown of each sample.
        cards: the samples that are shown.
        unshown: (key, error) of samples that cannot be shown.
    """
    counts = info.counts
    notes, tables, size = [], [], ""
    if unshown:
        notes.append(f"{_samples(len(unshown))} could not be shown: the tab Failures says why.")
    if not counts.samples:
        notes.append("This data set has no samples.")
    elif len(cards) + len(unshown) < counts.samples:
        notes.append(f"This page shows {len(cards):,} of the {_samples(counts.samples)}.")
    try:
        summary = describe(store)
        size = f", {summary.size / 1e6:,.0f} MB"
        tables = [_categories(summary, cards), _splits(summary), _members(summary)]
    except OcnfError as error:
        notes.append(f"There are no statistics, because an index is damaged: {error}")
    return Page(
        title=info.name, subtitle=f"A data set of {_samples(counts.samples)}{size}",
        scale=page_scale(manifest, choice), columns=COLUMNS, up=choice.up,
        facts=[("inputs", f"{counts.items:,}"), ("samples", f"{counts.samples:,}"),
               ("failures", f"{counts.failures:,}"), ("exclusions", f"{counts.exclusions:,}"),
               ("resolutions", ", ".join(f"{res}³" for res in manifest.resolutions)),
               *_input_facts(manifest, choice), ("target", str(manifest.target))],
        tables=tables, failures=_failures(store, unshown),
        provenance=[("Manifest", yaml.safe_dump(manifest.to_dict(), sort_keys=False)),
                    ("Fingerprint", "\n".join(fingerprint_lines(info.fingerprint)))],
        notes=notes)


def _samples(n: int) -> str:
    return "1 sample" if n == 1 else f"{n:,} samples"


def _input_facts(manifest: Manifest, choice: Choice) -> list[tuple[str, str]]:
    variant, tau = choice.variant, 1000 * manifest.truncation(choice.resolution)
    facts = [("input shown", f"{variant.name}: {', '.join(variant.encodings)}"),
             ("cube", f"{manifest.normalise.extent:g} m"),
             ("truncation τ", f"{tau:.3g} mm at {choice.resolution}³")]
    others = [one.name for one in manifest.inputs if one is not variant]
    return facts + ([("other inputs", ", ".join(others))] if others else [])


def _categories(summary: DatasetSummary, cards: list[Card]) -> PageTable:
    """A row a category: samples of each split, and the means of the columns over the samples shown."""
    splits = list(summary.splits)
    grouped: defaultdict[str, list[Card]] = defaultdict(list)
    for card in cards:
        grouped[card.category].append(card)
    names = sorted({name for part in summary.splits.values() for name in part.categories})
    rows: list[list[str | float | None]] = []
    for name in [*names, "all"]:
        numbers = [part.categories.total() if name == "all" and name not in names else part.categories[name]
                   for part in summary.splits.values()]
        mine = cards if name == "all" and name not in names else grouped[name]
        means = [_mean([card.values[column] for card in mine]) for column in range(len(COLUMNS))]
        rows.append([name, sum(numbers), *numbers, *means])
    return PageTable("By category", ["category", "samples", *splits, *(one.heading for one in COLUMNS)],
                     rows, "From `stored` on, means over the samples that are shown. Coverage: the share of "
                     "the pixels of all views that hit the mesh. Ground truth: its leaves as a share of the "
                     "voxels. Input error: the mean distance of the surface that plain fusion gives to the "
                     "ground truth's.", bars=[1], total=True)


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _splits(summary: DatasetSummary) -> PageTable:
    return PageTable("By split", ["split", "samples", "shards", "MB"],
                     [[name, part.categories.total(), part.shards, part.size / 1e6]
                      for name, part in summary.splits.items()], bars=[1])


def _members(summary: DatasetSummary) -> PageTable:
    rows: list[list[str | float | None]] = []
    for part in summary.members.values():
        is_octree = part.leaves > 0
        rows.append([part.name, part.count, part.size / 1e6, part.size / part.count / 1e3,
                     part.mean_leaves if is_octree else None, part.fewest if is_octree else None,
                     part.most if is_octree else None, 100 * part.fill if is_octree else None])
    head = ["member", "count", "MB", "kB each", "leaves, mean", "fewest", "most", "% of voxels"]
    return PageTable("What is stored", head, rows, bars=[2])


def _failures(store: Store, unshown: list[tuple[str, OcnfError]]) -> PageTable:
    """The rows of `failures.jsonl`, and the samples that this page could not show."""
    rows: list[list[str | float | None]] = [[key, "report", error.code, str(error)] for key, error in unshown]
    if store.exists(FAILURES):
        for line in store.read_at_most(FAILURES, _MAX_FAILURES).decode("utf-8", "replace").splitlines():
            try:
                row = json.loads(line)
                rows.append([str(row.get(name, "")) for name in ("item", "stage", "code", "message")])
            except (ValueError, AttributeError):
                rows.append(["", "", "damaged", f"{FAILURES} has a line that is not JSON: {line[:120]}"])
    return PageTable("Inputs that gave no sample", ["input", "stage", "code", "what is wrong"], rows)
