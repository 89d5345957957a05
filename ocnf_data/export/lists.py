"""The lists by which the projects that read points find their samples.

They name what lies in the folder: neither the limit of a run nor the order of several shows in them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.shards.catalogue import load_catalogue
from ocnf_data.shards.dataset import DatasetInfo

_OCCUPANCY, _DEEPSDF, _SAMPLES = "occupancy_networks/", "deepsdf/", "deepsdf/SdfSamples/ocnf/"

Named = Sequence[tuple[str, str]]
"""(category, key) of samples, in the data set's order."""


def write_lists(source: Store, target: Store, info: DatasetInfo, exported: Mapping[str, Named]) -> None:
    """Write CATEGORY/SPLIT.lst and SPLIT.json for every split that was exported by now.

    Each category has a list of each of these splits, an empty one too: Occupancy Networks opens them all.

    Args:
        source: the data set.
        target: the folder of the export.
        info: `dataset.json` of the data set.
        exported: (category, key) of what this run wrote or found, by split.
    """
    there = frozenset(target.list())
    categories = _categories(there)
    for split in info.splits:
        if split not in exported and f"{_DEEPSDF}{split}.json" not in there:
            continue
        try:
            samples: Named | None = _samples(source, info, split)
        except OcnfError:  # a damaged data set: what this run could read of it
            samples = exported.get(split)
        if samples is None:
            continue
        by_category: dict[str, list[str]] = {}
        for category, key in samples:
            if f"{_SAMPLES}{category}/{key}.npz" in there:
                by_category.setdefault(category, []).append(key)
        for category in categories:
            target.put_bytes(f"{_OCCUPANCY}{category}/{split}.lst",
                             "\n".join(by_category.get(category, [])).encode())
        target.put_bytes(f"{_DEEPSDF}{split}.json", json.dumps({"ocnf": by_category}, indent=1).encode())


def _categories(there: Iterable[str]) -> list[str]:
    """The categories that have a folder: of CATEGORY/KEY/*.npz or CATEGORY/SPLIT.lst."""
    return sorted({name.removeprefix(_OCCUPANCY).rsplit("/", 1 if name.endswith(".lst") else 2)[0]
                   for name in there if name.startswith(_OCCUPANCY) and name.endswith((".npz", ".lst"))})


def _samples(source: Store, info: DatasetInfo, split: str) -> Named:
    catalogue = load_catalogue(source, info, split)
    return [(catalogue.categories[number], key)
            for number, key in zip(catalogue.category_of, catalogue.keys, strict=True)]
