"""How much of the paper's data and training a table is made with: manifests and settings follow from it.

Every data set and network follows from a `Budget` and a table's declaration: two tables that need the same
get the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.manifest import Entry, Manifest
from ocnf_model.tables import WEIGHT_MODELS
from ocnf_model.tables.schema import PAPER_CATEGORIES, InputSpec, NetworkSpec, Pipeline, TableSpec
from ocnf_model.training.beginning import like_the_start
from ocnf_model.training.effects import no_effect
from ocnf_model.training.settings import TrainSettings, read_settings

PAPER_TRAIN, PAPER_VAL, PAPER_TEST = 200, 5, 20
"""Meshes of each category in the published selection."""
SCAN_TRAIN, SCAN_TEST = 12, 6
"""Of the paper's 20 configurations of each scan; two more validate."""
PAPER_RESOLUTIONS = (64, 128, 256)
PAPER_EPOCHS = (50, 25, 25)


@dataclass(frozen=True)
class Budget:
    """What a command is to spend.

    Attributes:
        categories: folders of the root that are used: categories of meshes, or scans.
        train, val, test: meshes of each category, or as many as there are; or configurations of each scan.
        settings: of training, but for input and encoding; levels and epochs among them.
        stand_ins: the root's folder that is taken for a category of the paper, by the paper's name.
        weight_models: validation models that TV-L1's weight is chosen on.
        of_scans: whether the root holds scans: depth frames of a real sensor.
    """

    categories: tuple[str, ...]
    train: int
    val: int
    test: int
    settings: TrainSettings
    stand_ins: Mapping[str, str] = field(default_factory=dict)
    weight_models: int = WEIGHT_MODELS
    of_scans: bool = False

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Voxels along each axis, level by level."""
        assert self.settings.resolutions is not None  # `make_budget` fills them in
        return self.settings.resolutions

    @property
    def epochs(self) -> tuple[int, ...]:
        """Epochs of each level."""
        return tuple(self.settings.stage(level).epochs for level in range(self.settings.levels))

    def with_epochs(self, epochs: Sequence[int]) -> Budget:
        """The same with other epochs; the last number holds for all later levels."""
        stages = [{**self.settings.stage(level).model_dump(mode="json"),
                   "epochs": epochs[min(level, len(epochs) - 1)]} for level in range(self.settings.levels)]
        fields = {**self.settings.to_dict(), "stages": stages}
        return replace(self, settings=read_settings(fields, "the budget"))

    def folder(self, category: str) -> str:
        """The root's folder for a category of the paper."""
        return self.stand_ins.get(category, category)

    def manifest(self, name: str, spec: InputSpec) -> Manifest:
        """The data set with this input; normalisation, cameras and truncation are the paper's.

        The first `val` files of a category's `train` folder validate, those after them train: so the
        validation meshes stay the same whatever the number of those to train on. Scans are cut in time.
        """
        if self.of_scans:
            source: dict[str, Any] = {
                "kind": "sequence", "scans": list(self.categories), "disjoint": False,
                "configurations": {"train": self.train, "val": self.val, "test": self.test}}
        else:
            source = {"kind": "modelnet", "categories": list(self.categories), "counts": {
                "val": {"folder": "train", "skip": 0, "count": self.val},
                "train": {"folder": "train", "skip": self.val, "count": self.train},
                "test": {"folder": "test", "skip": 0, "count": self.test}}}
        return Manifest.from_dict({
            "schema": 1, "name": name, "source": source, "resolutions": list(self.resolutions),
            "inputs": [{"name": name, "views": spec.views, "sigma": spec.sigma,
                        "encodings": [str(encoding) for encoding in spec.encodings]}]})

    def network_settings(self, spec: NetworkSpec) -> TrainSettings:
        """How a network is trained."""
        left_out = {self.folder(category) for category in spec.without}
        seen = [category for category in self.categories if category not in left_out] if left_out else None
        own = {"encoding": str(spec.encoding), "variant": spec.input, "categories": seen}
        return read_settings({**self.settings.to_dict(), **own}, f"network {spec.name}")


def make_budget(
    root: Path, tables: Sequence[TableSpec], *, meshes: int | None = None, test: int | None = None,
    settings: TrainSettings | None = None, resolutions: Sequence[int] | None = None,
    epochs: Sequence[int] | None = None, categories: Sequence[str] | None = None,
    stand_ins: Mapping[str, str] | None = None, weight_models: int = WEIGHT_MODELS,
) -> Budget:
    """The budget that a user names; what is not named is the paper's.

    Args:
        root: folder of the meshes, `ROOT/category/train|test/*.off` as in ModelNet; or of scans.
        tables: the tables that are to be made, all of meshes or all of scans.
        meshes: meshes to train a network on, over all categories; None: 200 of each.
        test: meshes of each category to test on; None: 20.
        settings: of training; None: the paper's. Their `levels` are kept.
        resolutions: level by level, as many as the settings have levels; None: those of the settings, else
            64, 128, 256.
        epochs: of each level, the last number for all later ones; None: those of the settings.
        categories: folders of the root; None: the paper's nine where the root has them, else all.
        stand_ins: folders of the root that are taken for categories of the paper.
        weight_models: validation models that TV-L1's weight is chosen on.

    Raises:
        OcnfError: the root lacks a category, there are fewer meshes than categories, ...
    """
    stand_ins = dict(stand_ins or {})
    settings = _of_tables(settings or TrainSettings())
    of_scans = all(table.pipeline is Pipeline.SCANS for table in tables)
    there = _folders_of(root, of_scans)
    chosen = _choose_categories(root, there, categories, stand_ins)
    for table in tables:
        for category in table.needed:
            if stand_ins.get(category, category) not in chosen:
                raise OcnfError(f"the table {table.name} needs a category that is not among those used",
                                code="missing", where=root, field="categories",
                                found=", ".join(chosen), expected=stand_ins.get(category, category),
                                fix=f"let another take its place: --stand-in {category}=FOLDER")
    n_train, n_test = (SCAN_TRAIN, SCAN_TEST) if of_scans else (PAPER_TRAIN, PAPER_TEST)
    n_train = n_train if meshes is None else meshes // len(chosen)
    if n_train < 1:
        raise OcnfError("the budget is too small for one epoch: fewer meshes than categories", code="budget",
                        field="--meshes", found=meshes, expected=f"at least {len(chosen)}, one of each",
                        fix="give more, or fewer categories with --categories")
    if epochs is not None and (not epochs or min(epochs) < 1):
        raise OcnfError("the budget is too small for one epoch", code="budget", field="--epochs",
                        found=list(epochs), expected="at least 1 for each level")
    grids = tuple(resolutions or settings.resolutions or PAPER_RESOLUTIONS[: settings.levels])
    if len(grids) != settings.levels:
        raise OcnfError("the levels do not fit the resolutions", field="levels", found=settings.levels,
                        expected=f"{len(grids)}, for {', '.join(map(str, grids))}")
    fields = {**settings.to_dict(), "resolutions": list(grids)}
    budget = Budget(chosen, n_train, max(1, min(PAPER_VAL, n_train // 5)),
                    n_test if test is None else test, read_settings(fields, "the budget"), stand_ins,
                    weight_models, of_scans)
    return budget.with_epochs(epochs or budget.epochs)


def _of_tables(settings: TrainSettings) -> TrainSettings:
    """The settings, with the architecture of a run that they start from; refused where tables have their own.

    Raises:
        OcnfError: code `manifest`, with the field.
    """
    for name in ("categories", "encoding", "mixture", "variant"):
        found, default = getattr(settings, name), TrainSettings.model_fields[name].default
        if found != default:
            raise no_effect(name, "the networks of a table have their own", "settings of a table", found,
                            default, "leave it out")
    if settings.output == "occupancy":
        raise OcnfError("tables are of distances", code="manifest", where="settings of a table",
                        field="output", found=settings.output, expected="tsdf")
    return like_the_start(settings)


def listed(budget: Budget, root: Path, views: int = 1) -> list[Entry]:
    """The meshes, or sets of frames of scans, that the budget takes, with their splits.

    Args:
        budget: the budget.
        root: the folder of the meshes or scans.
        views: frames in a set.

    Raises:
        OcnfError: a category has no mesh, a scan too few frames, or there is nothing for a split.
    """
    manifest = budget.manifest("listing", InputSpec(views=views, sigma=0.0, encodings=(Encoding.HISTOGRAM,)))
    entries = [entry for entry in manifest.entries(root) if entry.excluded is None]
    counts = Counter(entry.split for entry in entries)
    for split in ("train", "val", "test"):
        if not counts[split]:
            raise OcnfError("the budget is too small for one epoch: no mesh is left for a split",
                            code="budget", where=root, field=split,
                            found=", ".join(f"{name} {n}" for name, n in counts.items()),
                            expected=f"more than {budget.val} meshes in CATEGORY/train, any in CATEGORY/test")
    return entries


def _folders_of(root: Path, of_scans: bool) -> tuple[str, ...]:
    """The categories of meshes, or the scans, by name."""
    with storage_errors(root):
        there = tuple(sorted(path.name for path in root.iterdir() if not path.name.startswith(".")
                             and (path / ("" if of_scans else "train")).is_dir()))
    if not there and of_scans:
        raise OcnfError("no scan found", code="empty", where=root, field="--scans",
                        expected="folders of depth frames with poses")
    if not there:
        raise OcnfError("no category found", code="empty", where=root, field="--data",
                        expected="folders CATEGORY/train and CATEGORY/test with meshes, as in ModelNet")
    return there


def _choose_categories(root: Path, there: Sequence[str], asked: Sequence[str] | None,
                       stand_ins: Mapping[str, str]) -> tuple[str, ...]:
    if strangers := sorted(set(stand_ins) - set(PAPER_CATEGORIES)):
        raise OcnfError("not among the paper's categories", field="--stand-in", found=", ".join(strangers),
                        expected=", ".join(PAPER_CATEGORIES))
    published = [stand_ins.get(category, category) for category in PAPER_CATEGORIES]
    chosen = asked or (published if set(published) <= set(there) else there)
    for category in dict.fromkeys([*chosen, *stand_ins.values()]):
        if category not in there:
            raise OcnfError("the root lacks a category", code="missing", where=root, field="categories",
                            found=", ".join(there), expected=category,
                            fix="name others with --categories, or what takes its place with --stand-in")
    return tuple(dict.fromkeys(chosen))
