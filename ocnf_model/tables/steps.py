"""The steps that a table takes, in order: what each makes, and whether that is there already.

    OUT/data/VARIANT-KEY/               a data set for each input, for all tables
    OUT/weights/VARIANT-KEY.json        TV-L1's weights, chosen on its validation split; KEY-wN, and so what
                                        follows from them, where on another number of models than usual
    OUT/baselines/VARIANT-KEY/          VolFus and TV-L1 on its test split
    OUT/runs/NETWORK-KEY/               a training run for each network
    OUT/networks/NETWORK-KEY/           that network on the test split
    OUT/times/VARIANT-KEY.csv           seconds that encoding takes
    OUT/figures/NETWORK-KEY/*.png       models drawn with every method; KEY-y where that axis points up
    OUT/tables/NAME.md, .csv, .tex      the tables

KEY is a checksum of all that the content depends on: the meshes, the resolutions, the settings. Another
budget has other keys, so nothing is ever overwritten, and a step is done when what it makes is there: each
makes its last file at the end, in one piece.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.manifest import Entry
from ocnf_data.shards.dataset import DATASET
from ocnf_model.evaluation.methods import Method
from ocnf_model.tables import WEIGHT_MODELS
from ocnf_model.tables.budget import Budget
from ocnf_model.tables.schema import (
    InputSpec,
    Line,
    NetworkSpec,
    Quantity,
    TableSpec,
    all_encodings,
)
from ocnf_model.training.curves import CURVES
from ocnf_model.training.settings import TrainSettings

_KEY = 10  # hexadecimal digits


class StepKind(StrEnum):
    """What a step does, in the order in which a table needs them."""

    GENERATE = "generate"
    CHOOSE_WEIGHT = "choose-weight"
    BASELINES = "baselines"
    TRAIN = "train"
    EVALUATE = "evaluate"
    TIME = "time"
    DRAW = "draw"
    WRITE = "write"


@dataclass(frozen=True)
class Step:
    """One step.

    Attributes:
        kind: what it does.
        subject: the input, network, figure or table that it makes, by name.
        target: what is there when it is done, relative to the folder.
        variant: name of the input.
        input: what it is.
        network: the network, where there is one.
        category: folder of the root that a figure shows a model of.
        table: the table that is written.
    """

    kind: StepKind
    subject: str
    target: str
    variant: str = ""
    input: InputSpec | None = None
    network: NetworkSpec | None = None
    category: str = ""
    table: TableSpec | None = None

    @property
    def name(self) -> str:
        """What the plan and the log call it."""
        return f"{self.kind} {self.subject}"


class Layout:
    """Where everything lies in the folder of one budget.

    Args:
        out: the folder.
        budget: what is spent.
        entries: the meshes that the budget takes.
        sizes: bytes of each mesh file, so that other meshes of the same names are others.
        up: which axis of the models points up in figures: y or z.
    """

    def __init__(self, out: Path, budget: Budget, entries: Sequence[Entry], sizes: Mapping[str, int],
                 up: str = "z") -> None:
        self.out, self.budget, self.up = out, budget, up
        self._meshes = sorted((entry.split, str(entry.path), sizes.get(str(entry.path), 0))
                              for entry in entries)

    @staticmethod
    def input(variant: str, spec: InputSpec) -> InputSpec:
        """The input with the encodings that any table wants of it."""
        return spec.model_copy(update={"encodings": all_encodings(variant) or spec.encodings})

    def data(self, variant: str, spec: InputSpec) -> str:
        """Name of the folder of an input's data set."""
        manifest = self.budget.manifest(variant, self.input(variant, spec))
        return f"{variant}-{short_key([manifest.to_dict(), self._meshes])}"

    def weighed(self, made: str) -> str:
        """The name of what TV-L1's weights go into, of what it is made from: a data set or a run."""
        n = self.budget.weight_models
        return made if n == WEIGHT_MODELS else f"{made}-w{n}"

    def run(self, network: NetworkSpec, spec: InputSpec) -> str:
        """Name of the folder of a network's run."""
        settings, usual = self.budget.network_settings(network).decisive(), TrainSettings().decisive()
        # Those that are as usual do not count: a version with more settings finds the runs of this one.
        own = {name: value for name, value in settings.items() if usual.get(name) != value}
        return f"{network.name}-{short_key([own, self.data(network.input, spec)])}"

    def drawn(self, network: NetworkSpec, spec: InputSpec) -> str:
        """Name of the folder of a network's figures."""
        name = self.weighed(self.run(network, spec))
        return name if self.up == "z" else f"{name}-{self.up}"

    def is_done(self, step: Step) -> bool:
        """Whether what a step makes is there, whole."""
        target = self.out / step.target
        if step.kind is not StepKind.TRAIN:
            return step.kind is not StepKind.WRITE and target.is_file()
        if not target.is_file():
            return False
        with storage_errors(target), target.open(newline="") as file:
            rows = list(csv.DictReader(file))
        last = (self.budget.settings.levels, self.budget.epochs[-1])
        return bool(rows) and (int(rows[-1]["level"]), int(rows[-1]["epoch"])) == last


def plan_steps(tables: Sequence[TableSpec], layout: Layout) -> list[Step]:
    """All steps of some tables, each once, done or not: first all of the first table.

    The same list is printed by a dry run and then gone through.
    """
    ordered: dict[str, Step] = {}
    for table in tables:
        for step in _steps(table, layout):
            ordered.setdefault(step.name, step)
    return list(ordered.values())


def network_of(table: TableSpec, row: Line, column: Line) -> NetworkSpec | None:
    """The network of a cell, if it has one."""
    name = row.network or column.network
    is_ours = (row.method or column.method) is Method.OURS
    return table.networks[name] if is_ours and name is not None else None


def input_of(table: TableSpec, row: Line, column: Line) -> str | None:
    """Name of the input of a cell."""
    network = network_of(table, row, column)
    return row.input or column.input or (None if network is None else network.input)


def _steps(table: TableSpec, layout: Layout) -> Iterator[Step]:
    budget = layout.budget
    inputs = {name: layout.input(name, spec) for name, spec in table.inputs.items()}
    data = {name: layout.data(name, spec) for name, spec in inputs.items()}
    for name, spec in inputs.items():
        yield Step(StepKind.GENERATE, name, f"data/{data[name]}/{DATASET}", name, spec)
    for name, spec in inputs.items():
        yield Step(StepKind.CHOOSE_WEIGHT, name, f"weights/{layout.weighed(data[name])}.json", name, spec)
        yield Step(StepKind.BASELINES, name, f"baselines/{layout.weighed(data[name])}/models.csv", name,
                   spec)
    for network in table.networks.values():
        spec = inputs[network.input]
        run = layout.run(network, spec)
        yield Step(StepKind.TRAIN, network.name, f"runs/{run}/{CURVES}", network.input, spec, network)
        yield Step(StepKind.EVALUATE, network.name, f"networks/{run}/models.csv", network.input, spec,
                   network)
    if table.quantity is Quantity.SECONDS:
        for name, spec in inputs.items():
            yield Step(StepKind.TIME, name, f"times/{data[name]}.csv", name, spec)
    for category in map(budget.folder, table.figures):
        if category in budget.categories:
            network = list(table.networks.values())[-1]  # the paper's own encoding stands last
            spec = inputs[network.input]
            target = f"figures/{layout.drawn(network, spec)}/{category}.png"
            yield Step(StepKind.DRAW, f"{category} by {network.name}", target, network.input, spec, network,
                       category)
    yield Step(StepKind.WRITE, table.name, f"tables/{table.name}.md", table=table)


def short_key(content: object) -> str:
    """A checksum of JSON values, short enough for a folder's name."""
    return sha256_hex(canonical_json(content))[:_KEY]
