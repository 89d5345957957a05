"""The page of an evaluation: every model with its reconstructions in 3-D, beside the figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import yaml

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.manifest import Manifest
from ocnf_data.report.contents import Card
from ocnf_data.report.page import Column, Page, PageTable, PageWriter
from ocnf_data.report.sample import Choice, Reconstructed, make_picture, page_scale
from ocnf_data.shards.browse import StoredSample
from ocnf_data.shards.catalogue import load_catalogue
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.shards.reader import ShardReader
from ocnf_model.evaluation.measure import TRUTH, Result
from ocnf_model.evaluation.methods import Method
from ocnf_model.evaluation.models import VariantPlan
from ocnf_model.evaluation.summary import ALL, Summary

_SAYS = {Method.VOLFUS.label: "plain fusion", Method.TVL1.label: "fused with total variation",
         Method.OURS.label: "the network's output"}
_HEAD = ("MAD, mm", "MAD / VolFus", "IoU", "F-score", "Chamfer, mm", "normals", "seconds")
_LEGEND = ("MAD: mean absolute difference of the TSDF over all voxels. MAD / VolFus: below 1 is better than "
           "plain fusion. F-score: harmonic mean of the shares of either surface within one voxel of the "
           "other. Chamfer: mean distance from samples of either surface to the other, averaged. Normals: "
           "mean |cosine|. A ground truth's line is what its resolution can hold of the true surface.")


class EvaluationPage:
    """Gathers the models of an evaluation one by one, and writes their page at the end.

    Args:
        path: the HTML file.
        data: the data set, a folder or URL.
        split: its split.
        meshes: the folder of its meshes, or None: then the surface of the ground truth may stand in for them.
        up: the axis that points up, y or z.
        triangles: the most of a surface.

    Raises:
        OcnfError: the page cannot be written there, or the data set's manifest cannot be read.
    """

    def __init__(self, path: Path, data: str, split: str, meshes: Path | None, up: str,
                 triangles: int = 20_000) -> None:
        self._writer = PageWriter(path)
        self._store = Store(data)
        self._info = load_dataset(self._store)
        self._manifest = Manifest.from_dict(self._info.manifest)
        self._split, self._meshes, self._up, self._triangles = split, meshes, up, triangles
        self._labels: list[str] = []
        self._failures: list[list[str | float | None]] = []
        self._plans: list[VariantPlan] = []

    def begin(self, plans: Sequence[VariantPlan]) -> None:
        """Say which variants and methods there will be."""
        self._plans = list(plans)
        labels = (plan.label(method) for method in Method for plan in plans if method in plan.sources)
        self._labels = list(dict.fromkeys(labels))

    def add(self, key: str, variant: str, results: Sequence[Result]) -> None:
        """Add a model; one that cannot be shown is named on the page.

        Args:
            key: the model's.
            variant: name of the input variant.
            results: all that the bench found; of each method the finest is shown.
        """
        finest = {one.row.method: one for one in sorted(results, key=lambda one: one.row.resolution)}
        finest.pop(TRUTH, None)
        try:
            sample = self._sample(key)
            choice = self._choice(variant)
            shown = [_reconstructed(finest[label]) for label in self._labels if label in finest]
            picture = make_picture(sample, self._manifest, choice, self._meshes, shown, first=shown[-1].name)
            name = key if len(self._plans) == 1 else f"{key} ({variant})"
            values = [value for label in self._labels for value in _values(finest.get(label))]
            self._writer.add(Card(name, variant, sample.entry.category, sample.entry.source, values,
                                  picture.thumbnail, picture.blob))
        except OcnfError as error:
            self._failures.append([f"{key} ({variant})", error.code, str(error)])

    def finish(self, title: str, summaries: Sequence[Summary], ceilings: Sequence[Summary],
               notes: Sequence[str]) -> list[Path]:
        """Write the page; its path, and that of the folder beside it if there is one.

        Args:
            title: of the evaluation.
            summaries: means over models.
            ceilings: those of the ground truth itself.
            notes: what was left out or is approximate, a clause each.
        """
        manifest, counts = self._manifest, self._info.counts
        columns = [column for label in self._labels
                   for column in (Column(f"{label} MAD", "mm", 2), Column(f"{label} F-score", "", 3))]
        choice = self._choice(self._plans[0].variant)
        said = [f"{len(self._failures)} models could not be shown: the tab Failures says why."] * bool(
            self._failures) + [f"{note}." for note in notes]
        page = Page(
            title=f"Evaluation on {self._info.name}", subtitle=title, scale=page_scale(manifest, choice),
            columns=columns, up=self._up, group="Input",
            facts=[("models", f"{len(self._writer):,}"), ("split", self._split),
                   ("of", f"{counts.samples:,} samples"), ("methods", ", ".join(self._labels)),
                   ("inputs", ", ".join(plan.variant for plan in self._plans)),
                   ("resolutions", ", ".join(f"{res}³" for res in manifest.resolutions)),
                   ("cube", f"{manifest.normalise.extent:g} m")],
            tables=[table for plan in self._plans for table in _tables(plan.variant, summaries, ceilings)],
            failures=PageTable("Models that are not shown", ["model", "code", "what is wrong"],
                               self._failures),
            provenance=[("Manifest of the data set", yaml.safe_dump(manifest.to_dict(), sort_keys=False))],
            notes=said)
        return self._writer.finish(page)

    def _choice(self, variant: str) -> Choice:
        entry = next(one for one in self._manifest.inputs if one.name == variant)
        return Choice(entry, max(self._manifest.resolutions), self._triangles, self._up)

    def _sample(self, key: str) -> StoredSample:
        place = load_catalogue(self._store, self._info, self._split).find(key)
        if place is None:
            raise OcnfError("the split has no such sample", code="missing", where=self._store.url, found=key)
        shard, position = place
        reader = ShardReader(self._store, self._split, self._info.splits[self._split][shard])
        return StoredSample(reader, position, reader.index.samples[position])


def _reconstructed(found: Result) -> Reconstructed:
    label = found.row.method
    return Reconstructed(label, found.field.signed(), Encoding.TSDF,
                         f"{_SAYS[label.rstrip('*')]}, {found.row.resolution}³")


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _values(found: Result | None) -> tuple[float | None, float | None]:
    if found is None:
        return None, None
    return _known(found.row.mad_mm), _known(found.row.surface.f_score)


def _tables(variant: str, summaries: Sequence[Summary], ceilings: Sequence[Summary]) -> list[PageTable]:
    """The means over all models by resolution, and those of the finest resolution by category."""
    mine = [one for one in (*summaries, *ceilings) if one.variant == variant]
    finest = max((one.resolution for one in mine), default=0)
    over_all = sorted((one for one in mine if one.category == ALL), key=lambda one: one.resolution)
    by_category = sorted((one for one in mine if one.category != ALL and one.resolution == finest),
                         key=lambda one: one.category)
    return [
        PageTable(f"{variant}: means over all models", ["grid", "method", "models", *_HEAD],
                  [[f"{one.resolution}³", one.method, one.n_models, *_cells(one)] for one in over_all],
                  _LEGEND),
        PageTable(f"{variant}: by category at {finest}³", ["category", "method", "models", *_HEAD],
                  [[one.category, one.method, one.n_models, *_cells(one)] for one in by_category]),
    ]


def _cells(one: Summary) -> list[float | None]:
    surface = one.surface
    return [_known(value) for value in (one.mad_mm, one.ratio.value, one.iou, surface.f_score,
                                        surface.chamfer_mm, surface.normal_consistency, one.seconds)]
