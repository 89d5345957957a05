"""Seconds that the encoding of a model's views takes, which no data set keeps."""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from ocnf_data.encodings import Encoding
from ocnf_data.files.storage import Store
from ocnf_data.fusion import fuse_histogram, fuse_tsdf
from ocnf_data.generation.remake import remake
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.views.cameras import Views
from ocnf_model.evaluation.models import DatasetFacts, Models

_FUSE: dict[Encoding, Callable[[Views, int, float, float], GridOctree]] = {
    Encoding.TSDF: fuse_tsdf, Encoding.HISTOGRAM: fuse_histogram}


def time_encodings(data: str, root: Path, out: Path, limit: int | None = None) -> None:
    """Encode the noisy views of each test model again, and write `key,resolution,encoding,seconds`.

    Args:
        data: a data set with one input.
        root: the folder of its meshes.
        out: the CSV file, written at the end.
        limit: the first so many models only.
    """
    facts = DatasetFacts.read(data)
    manifest = Manifest.from_dict(load_dataset(data).manifest)
    variant, encodings = next(iter(facts.variants.items()))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["key", "resolution", "encoding", "seconds"])
    models = Models(facts, "test", variant, encodings[:1], facts.resolutions[:1], limit)
    for number, model in enumerate(models):
        views = remake(manifest, model.facts, root).observed[variant]
        if not number:  # what is compiled or read from a cache on first use is no part of it
            list(_timed(views, facts))
        writer.writerows([model.key, *found] for found in _timed(views, facts))
    Store(out.parent).put_bytes(out.name, text.getvalue().encode())


def _timed(views: Views, facts: DatasetFacts) -> Iterator[tuple[int, str, float]]:
    for resolution in facts.resolutions:
        for encoding, fuse in _FUSE.items():
            begin = time.perf_counter()
            fuse(views, resolution, facts.extent, facts.taus[resolution])
            yield resolution, str(encoding), time.perf_counter() - begin
