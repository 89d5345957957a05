"""What methods are compared on: a data set's models, their ground truth and the inputs of each method."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.loading.dataset import Batch, ShardDataset
from ocnf_data.octree import GridOctree
from ocnf_data.shards.dataset import load_dataset
from ocnf_model.evaluation.methods import Method
from ocnf_model.measures.regions import EXACT, NEARLY

_VOLFUS_SOURCES = (Encoding.TSDF, Encoding.TDF_OCCUPANCY, Encoding.HISTOGRAM)  # the best one first


@dataclass(frozen=True)
class DatasetFacts:
    """What the manifest of a data set says that matters here.

    Attributes:
        url: URL of the data set.
        identity: SHA-256 that tells it from others.
        resolutions: ascending.
        variants: the encodings of each input variant.
        is_occupancy: whether the ground truth is occupancy, not TSDF.
        truncation_voxels: tau in voxels of any resolution.
        taus: tau in metres, by resolution.
        extent: size of the cube in metres.
        source: kind of what the data set was made of: `shapes`, `folder`, ...
    """

    url: str
    identity: str
    resolutions: tuple[int, ...]
    variants: Mapping[str, tuple[Encoding, ...]]
    is_occupancy: bool
    truncation_voxels: float
    taus: Mapping[int, float]
    extent: float
    source: str

    @classmethod
    def read(cls, url: str) -> DatasetFacts:
        """The facts of the data set at a folder or URL.

        Raises:
            OcnfError: its manifest lacks what is needed (`damaged`), beside what `load_dataset` raises.
        """
        info = load_dataset(url)
        manifest: dict[str, Any] = dict(info.manifest)
        try:
            resolutions = tuple(sorted(int(resolution) for resolution in manifest["resolutions"]))
            voxels, extent = float(manifest["truncation_voxels"]), float(manifest["normalise"]["extent"])
            return cls(
                url=url,
                identity=info.identity,
                resolutions=resolutions,
                variants={entry["name"]: tuple(map(Encoding, entry["encodings"]))
                          for entry in manifest["inputs"]},
                is_occupancy=manifest["target"] == "occupancy",
                truncation_voxels=voxels,
                taus={resolution: voxels * extent / resolution for resolution in resolutions},
                extent=extent,
                source=str(manifest["source"]["kind"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise OcnfError("the data set's manifest lacks what evaluation needs", code="damaged", where=url,
                            field="manifest", found=f"{type(error).__name__}: {error}") from error


@dataclass(frozen=True)
class VariantPlan:
    """What a variant is evaluated with.

    Attributes:
        variant: name of the input variant.
        sources: the stored encoding that each method takes.
        seen: the stored encoding that tells best which voxels the inputs see; None where none does.
    """

    variant: str
    sources: Mapping[Method, Encoding]
    seen: Encoding | None = None

    @property
    def encodings(self) -> list[Encoding]:
        """What is read, each once."""
        wanted = [*self.sources.values(), *([] if self.seen is None else [self.seen])]
        return list(dict.fromkeys(wanted))

    def is_approximate(self, method: Method) -> bool:
        """Whether the method is VolFus from a histogram."""
        return method is Method.VOLFUS and self.sources[method] is Encoding.HISTOGRAM

    def label(self, method: Method) -> str:
        """The method's name in tables; approximate ones have a star."""
        return method.label + "*" * self.is_approximate(method)


def plan_variants(facts: DatasetFacts, methods: Sequence[Method], encoding: Encoding | None, *,
                  required: bool) -> tuple[list[VariantPlan], list[str]]:
    """A plan for each variant that some method can be run on, and notes on what cannot.

    Args:
        facts: what the manifest of the data set says.
        methods: the methods to plan for.
        encoding: encoding that the network takes; None without a network.
        required: whether each method has to run on some variant.

    Raises:
        OcnfError: code `missing`, if a method that has to cannot run, or none can.
    """
    plans, notes = [], []
    for variant, stored in facts.variants.items():
        sources: dict[Method, Encoding] = {}
        for method in methods:
            wanted = {Method.VOLFUS: _VOLFUS_SOURCES, Method.TVL1: (Encoding.HISTOGRAM,),
                      Method.OURS: () if encoding is None else (encoding,)}[method]
            found = next((one for one in wanted if one in stored), None)
            if found is None:
                notes.append(f"{method.label} needs {' or '.join(wanted)}, which variant {variant} lacks")
            else:
                sources[method] = found
        if sources:
            seen = next((one for one in (*EXACT, *NEARLY) if one in stored), None)
            plans.append(VariantPlan(variant, sources, seen))
            if sources.get(Method.VOLFUS) is Encoding.HISTOGRAM:
                notes.append(f"VolFus* of {variant} is the mean of the histogram, an approximation; add tsdf "
                             "to the encodings of the data set's inputs to have it exactly")
    ran = {method for plan in plans for method in plan.sources}
    if not plans or (required and ran != set(methods)):
        raise OcnfError("the data set lacks the inputs that a method needs", code="missing", where=facts.url,
                        field="inputs", found="; ".join(notes) or "no inputs",
                        fix="name other methods, or generate with these encodings")
    return plans, notes


@dataclass(frozen=True, eq=False)
class Model:
    """One sample: octrees by resolution, inputs by encoding first.

    Attributes:
        facts: the sample's `json` member.
    """

    key: str
    category: str
    facts: Mapping[str, Any]
    truths: Mapping[int, GridOctree]
    inputs: Mapping[Encoding, Mapping[int, GridOctree]]


class Models:
    """The models of a split and variant, in the data set's own order, each once.

    Args:
        facts: what the manifest of the data set says.
        split: `train`, `val` or `test`.
        variant: name of the input variant.
        encodings: the input encodings to read; at least one.
        resolutions: the resolutions to read, voxels along each axis.
        limit: the first so many only; None for all.
        categories: models of these only; None for all.

    Raises:
        OcnfError: the data set lacks what is asked for, or is damaged: where, and what there is.
    """

    def __init__(self, facts: DatasetFacts, split: str, variant: str, encodings: Sequence[Encoding],
                 resolutions: Sequence[int], limit: int | None = None,
                 categories: Sequence[str] | None = None) -> None:
        if limit is not None and limit < 1:
            raise OcnfError("no models are asked for", field="limit", found=limit, expected="1 or more")
        self._encodings = list(encodings)
        self._sets = [
            ShardDataset(facts.url, split, list(resolutions), encoding, variant, categories=categories,
                         shuffle=False, uneven="exact", rank=0, world_size=1, targets=number == 0)
            for number, encoding in enumerate(self._encodings)
        ]
        self._limit = limit

    def __len__(self) -> int:
        return min(len(self._sets[0]), self._limit or len(self._sets[0]))

    def __iter__(self) -> Iterator[Model]:
        for dataset in self._sets:
            dataset.set_epoch(0)
        for batches in islice(zip(*self._sets, strict=True), len(self)):
            yield self._model(batches)

    def _model(self, batches: Sequence[Batch]) -> Model:
        first = batches[0]
        return Model(
            key=first.keys[0],
            category=first.categories[0],
            facts=first.meta[0],
            truths={resolution: octrees.grids()[0] for resolution, octrees in first.targets.items()},
            inputs={encoding: {resolution: octrees.grids()[0] for resolution, octrees in batch.inputs.items()}
                    for encoding, batch in zip(self._encodings, batches, strict=True)},
        )
