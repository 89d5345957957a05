"""What a run trains on and is validated with: a data set on disk, or a manifest that samples are drawn from.

A manifest's validation samples are those of its split `val`. They are made once, as a data set in
RUN/validation, so that every epoch is measured with the same ones; `--val` names another data set for it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.loading.arguments import OnError
from ocnf_data.loading.catalogue import check_meaning
from ocnf_data.loading.dataset import ShardDataset
from ocnf_data.loading.epochs import EpochDataset
from ocnf_data.loading.mixture import MixtureDataset
from ocnf_data.shards import load_dataset
from ocnf_model.training.effects import refuse_idle_part
from ocnf_model.training.inputs import (
    refuse_unknown_variant,
    with_first_variant,
    with_training_variant,
    with_validation_variant,
)
from ocnf_model.training.record import VALIDATION, draws_apart
from ocnf_model.training.settings import MixturePart, TrainSettings

if TYPE_CHECKING:
    from ocnf_data.synthesis.sources import Sources

CACHE = "cache"
"""Folder in a run of the ground truths that epochs share."""
_MANIFESTS = frozenset({".yaml", ".yml", ".json"})


class DataSource(Protocol):
    """What `train` needs of its data; levels count from 0, resolutions come coarse to fine."""

    where: str
    """Name of the data, for messages."""
    manifest: dict[str, Any]
    """The resolved manifest, which says what the values mean."""

    def prepare(self, folder: Path, settings: TrainSettings, console: Console) -> None:
        """Make what has to be on disk, in the folder of the run; a second call finds it there."""

    def training(self, folder: Path, settings: TrainSettings, level: int) -> EpochDataset:
        """The samples to train a level on."""

    def validation(self, folder: Path, settings: TrainSettings, level: int) -> EpochDataset:
        """The samples to validate a level with, each once."""


@dataclass(frozen=True)
class OtherData:
    """A data set to validate with that is not the one that is trained on.

    Attributes:
        url: folder or fsspec URL.
        manifest: its resolved manifest.
    """

    url: str
    manifest: dict[str, Any]

    @classmethod
    def checked(cls, url: str, training: dict[str, Any], where: str) -> OtherData:
        """The data set, if its values mean what those to train on do.

        Args:
            url: folder or fsspec URL.
            training: manifest of what is trained on.
            where: its name, for messages.
        """
        manifest = dict(load_dataset(url).manifest)
        check_meaning(url, manifest, where, training)
        return cls(url, manifest)

    def validation(self, settings: TrainSettings, level: int, training: dict[str, Any]) -> ShardDataset:
        """As `open_validation`, in the variant of it that the settings mean."""
        settings = with_validation_variant(settings, self.manifest, self.url, training)
        return open_validation(self.url, settings, level, training)


class StoredData:
    """A data set that `generate` made, with both splits.

    Args:
        url: folder or fsspec URL of the data set.
        val: a data set to validate with in its place.
    """

    def __init__(self, url: str, val: str | None = None) -> None:
        self.where, self.manifest = url, dict(load_dataset(url).manifest)
        self._val = None if val is None else OtherData.checked(val, self.manifest, url)

    def prepare(self, folder: Path, settings: TrainSettings, console: Console) -> None:
        """Do nothing: everything is there."""

    def training(self, folder: Path, settings: TrainSettings, level: int) -> EpochDataset:
        """The training split, all of it in every epoch or as many samples as the settings say."""
        dataset = ShardDataset(
            self.where, settings.train_split, settings.up_to(level, self.manifest), settings.encoding,
            variant=settings.variant, targets=settings.own(level, self.manifest),
            categories=settings.categories, seed=settings.seed,
            on_error=settings.on_error, batch_size=settings.stage(level).batch_size,
            augment=settings.augment, buffer=settings.shuffle_buffer)
        if settings.samples_per_epoch is None:
            return dataset
        return _mix([(dataset, 1.0)], settings, level, draws_apart(folder))

    def validation(self, folder: Path, settings: TrainSettings, level: int) -> ShardDataset:
        """The validation split."""
        if self._val is not None:
            return self._val.validation(settings, level, self.manifest)
        return open_validation(self.where, settings, level, self.manifest)

    def with_variant(self, settings: TrainSettings) -> TrainSettings:
        """The settings with the variant to train on, where another data set is validated with."""
        if self._val is None:
            return settings
        return with_training_variant(settings, self.manifest, self.where, self._val.manifest)


class DrawnData:
    """A manifest, whose training samples are drawn without end.

    Args:
        path: path of the YAML file.
        meshes: the folder that its mesh paths are relative to.
        val: a data set to validate with; None makes one of the manifest's split.
        train_split: name of the split that is drawn from.
        categories: only these.
    """

    def __init__(self, path: str, meshes: Path | None, val: str | None, train_split: str,
                 categories: tuple[str, ...] | None) -> None:
        from ocnf_data.manifest import load_manifest
        from ocnf_data.synthesis.sources import open_sources

        given = load_manifest(path)
        self.where = path
        self._root = given.meshes_root(meshes)
        self.reads_meshes = self._root is not None
        self._sources: Sources = open_sources(given, self._root, train_split, categories)
        self.manifest = self._sources.manifest.to_dict()
        self._val = None if val is None else OtherData.checked(val, self.manifest, path)

    def prepare(self, folder: Path, settings: TrainSettings, console: Console) -> None:
        """Make the validation set, if it is not there yet, or raise OcnfError; say what failed of it."""
        if self._val is not None:
            return
        from ocnf_model.training.making import make_validation

        refuse_unknown_variant(settings, self.manifest, self.where)
        # What is drawn for training is no part of it: a run with other draws is measured with the same one.
        manifest = self._sources.manifest.model_copy(update={"synthesis": None})
        if not any(entry.split == settings.val_split
                   for entry in manifest.source.entries(self._root, manifest.seed)):
            raise OcnfError("the manifest has no samples to validate with", code="empty", where=self.where,
                            field=f"source, split {settings.val_split}",
                            fix="give the split some, or name a data set with --val")
        make_validation(manifest, self._root, folder, settings.val_split, console)

    def training(self, folder: Path, settings: TrainSettings, level: int) -> EpochDataset:
        """Samples drawn from the manifest."""
        from ocnf_data.synthesis.dataset import SynthesisDataset

        return SynthesisDataset(
            self._sources, settings.up_to(level, self.manifest), settings.encoding,
            targets=settings.own(level, self.manifest), split=settings.train_split,
            categories=settings.categories, seed=settings.seed, batch_size=settings.stage(level).batch_size,
            augment=settings.augment, cache=folder / CACHE,
            samples_per_epoch=settings.samples_per_epoch)

    def validation(self, folder: Path, settings: TrainSettings, level: int) -> ShardDataset:
        """The validation set, in the one variant that the settings name or the manifest names first."""
        if self._val is not None:
            return self._val.validation(settings, level, self.manifest)
        settings = with_first_variant(settings, self.manifest, self.where)
        return open_validation(str(folder / VALIDATION), settings, level, self.manifest)


class MixedData:
    """Several data sets and manifests, drawn from by weight.

    Args:
        base: what is validated with, and whose manifest says what values mean.
        parts: each with its weight and the variant of its inputs.
    """

    def __init__(self, base: DataSource, parts: Sequence[tuple[DataSource, MixturePart]]) -> None:
        self._base, self._parts = base, parts
        self.where, self.manifest = base.where, base.manifest

    def refuse_idle(self) -> None:
        """Refuse fields of parts that would have no effect; where a run is begun."""
        for number, (source, part) in enumerate(self._parts):
            drawn = isinstance(source, DrawnData)
            names = [entry["name"] for entry in source.manifest["inputs"]] if drawn else None
            refuse_idle_part(number, part, names, isinstance(source, DrawnData) and source.reads_meshes)

    def prepare(self, folder: Path, settings: TrainSettings, console: Console) -> None:
        """Prepare the data set that is validated with."""
        self._base.prepare(folder, settings, console)

    def training(self, folder: Path, settings: TrainSettings, level: int) -> EpochDataset:
        """Samples of all parts."""
        from ocnf_data.synthesis.dataset import SynthesisDataset

        mixed, apart = [], draws_apart(folder)
        for number, (source, part) in enumerate(self._parts):
            own = settings.model_copy(update={
                "variant": part.variant, "samples_per_epoch": None,
                "seed": _seed_of_part(settings.seed, number) if apart else settings.seed})
            dataset = source.training(folder, own, level)
            assert isinstance(dataset, ShardDataset | SynthesisDataset)
            mixed.append((dataset, part.weight))
        return _mix(mixed, settings, level, apart)

    def validation(self, folder: Path, settings: TrainSettings, level: int) -> EpochDataset:
        """The base's validation set, in the variant that the settings name or its manifest names first."""
        return self._base.validation(folder, with_first_variant(settings, self.manifest, self.where), level)


def open_data(data: str, settings: TrainSettings, meshes: Path | None = None,
              val: str | None = None) -> DataSource:
    """A manifest's or a data set's samples, by the name's ending, or those of the settings' mixture.

    Args:
        data: path of a manifest (.yaml, .yml, .json), else folder or URL of a data set; OcnfError if neither.
        settings: settings of the run; OcnfError for a mixture without `samples_per_epoch`.
        meshes: the folder that a manifest's mesh paths are relative to; OcnfError for a data set alone.
        val: a data set to validate with.
    """
    if settings.mixture is not None:
        if settings.samples_per_epoch is None:
            raise OcnfError("a mixture has no end, so the settings have to say how long an epoch is",
                            where="the settings", field="samples_per_epoch", expected="a number of samples")
        alone = settings.model_copy(update={"mixture": None, "samples_per_epoch": None})
        base = open_data(data, alone, meshes if is_manifest(data) else None, val)
        parts = [(base if part.data is None else _open_part(part, alone, meshes), part)
                 for part in settings.mixture]
        return MixedData(base, parts)
    if is_manifest(data):
        return DrawnData(data, meshes, val, settings.train_split, settings.categories)
    if meshes is not None:
        raise OcnfError("a data set on disk needs no meshes", where="the command line", field="--meshes",
                        found=meshes, fix="name a manifest (.yaml) to draw from, or leave --meshes out")
    return StoredData(data, val)


def is_manifest(data: str) -> bool:
    """Whether it is the path of a manifest, not a data set."""
    return Path(data).suffix.lower() in _MANIFESTS


def _open_part(part: MixturePart, settings: TrainSettings, meshes: Path | None) -> DataSource:
    assert part.data is not None
    root = meshes if part.meshes is None else Path(part.meshes)
    return open_data(part.data, settings, root if is_manifest(part.data) else None)


def _seed_of_part(seed: int, number: int) -> int:
    """Each part's own, or two variants of a data set would come in one order; the first has the run's."""
    if number == 0:
        return seed
    return int.from_bytes(hashlib.sha256(f"ocnf part {seed} {number}".encode()).digest()[:6], "little")


def _mix(parts: Sequence[tuple[Any, float]], settings: TrainSettings, level: int,
         apart: bool) -> EpochDataset:
    assert settings.samples_per_epoch is not None
    # Meshes of a manifest are found to be bad as they are drawn, with or without a mixture: none stops a run.
    policies = [settings.on_error if isinstance(part, ShardDataset) else OnError.SKIP for part, _ in parts]
    mixture = MixtureDataset(parts, settings.samples_per_epoch, seed=settings.seed,
                             batch_size=settings.stage(level).batch_size, on_error=policies,
                             augment=settings.augment)
    return mixture if apart else mixture.as_before()


def open_validation(url: str, settings: TrainSettings, level: int, manifest: dict[str, Any]) -> ShardDataset:
    """Each validation sample of a data set exactly once.

    Args:
        url: the data set.
        settings: settings of the run.
        level: number of the level, from 0.
        manifest: manifest of what is trained on.
    """
    return ShardDataset(
        url, settings.val_split, settings.up_to(level, manifest), settings.encoding,
        variant=settings.variant, targets=settings.own(level, manifest), categories=settings.categories,
        seed=settings.seed, on_error=settings.on_error, shuffle=False, uneven="exact")
