"""How long steps take on this machine and how large what they make is, measured on a few meshes.

The pipeline itself runs on one training, validation and test mesh of up to six categories; what it took is
scaled to the budget. Nothing is known beforehand of the machine, the meshes or the settings.
"""

from __future__ import annotations

import csv
import json
import shutil
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json, sha256_hex
from ocnf_data.files.storage import Store
from ocnf_data.files.validation import Real, Strict, validate
from ocnf_data.manifest.schema import Shards
from ocnf_data.shards.tarformat import JSON, parse_member
from ocnf_data.verify.summary import describe
from ocnf_model.evaluation.run import run_choose_weight
from ocnf_model.tables.budget import Budget, listed
from ocnf_model.tables.execute import Executor
from ocnf_model.tables.schema import InputSpec, NetworkSpec, TableSpec
from ocnf_model.tables.steps import Layout, Step, StepKind
from ocnf_model.training.curves import CURVES
from ocnf_model.training.run import train
from ocnf_model.training.settings import TrainSettings, read_settings

FILE = "rates.json"
_MOST_CATEGORIES = 6
_FEW, _MANY = 2, 8  # samples an epoch, of the two short trainings whose difference is the time of a sample
_WEIGHTS = 7  # that are tried for each resolution
_WEIGHT_MODELS = 2
_DRAWING = 3.0  # seconds a figure
_SHARD = Shards().samples  # what one worker makes at a time


class Rates(Strict):
    """What was measured; seconds and bytes.

    Attributes:
        generate: seconds a sample, by stage, with the calibration's input; `fixed` of the whole step.
        encodings: how many encodings that input has.
        members: bytes a sample, of the ground truth and of each encoding, all resolutions together.
        train_sample, train_validation: seconds a sample and epoch, level by level; train_fixed of the step.
        run_bytes: size of a run's folder.
        weigh, baselines, evaluate, time: seconds a model.
    """

    generate: dict[str, Real]
    encodings: int
    members: dict[str, Real]
    train_sample: tuple[Real, ...]
    train_validation: tuple[Real, ...]
    train_fixed: Real
    run_bytes: Real
    weigh: Real
    baselines: Real
    evaluate: Real
    time: Real


@dataclass(frozen=True)
class Estimate:
    """What a step is expected to take."""

    seconds: float
    size: float


class Estimator:
    """Scales rates to a budget.

    Args:
        rates: of this machine.
        layout: the budget's.
        root: the folder of the meshes.
        jobs: worker processes of generation.
    """

    def __init__(self, rates: Rates, layout: Layout, root: Path, jobs: int) -> None:
        self._rates, self._layout, self._jobs = rates, layout, jobs
        self._counts = Counter(entry.split for entry in listed(layout.budget, root))
        self._by_category = Counter((entry.split, entry.category) for entry in listed(layout.budget, root))

    def of(self, step: Step) -> Estimate:
        """What a step takes from its beginning."""
        rates, n_test = self._rates, self._counts["test"]
        match step.kind:
            case StepKind.GENERATE:
                assert step.input is not None
                return self._generation(step.input)
            case StepKind.CHOOSE_WEIGHT:
                n = min(self._layout.budget.weight_models, self._counts["val"])
                return Estimate(rates.weigh * n, 0)
            case StepKind.BASELINES:
                return Estimate(rates.baselines * n_test, 0)
            case StepKind.TRAIN:
                assert step.network is not None
                return Estimate(rates.train_fixed + sum(
                    epochs * seconds for epochs, seconds in zip(
                        self._layout.budget.epochs, self.epoch_seconds(step.network), strict=True)),
                    rates.run_bytes)
            case StepKind.EVALUATE:
                return Estimate(rates.evaluate * n_test, 0)
            case StepKind.TIME:
                return Estimate(rates.time * n_test, 0)
            case StepKind.DRAW:
                return Estimate(rates.evaluate + rates.baselines + _DRAWING, 0)
            case _:
                return Estimate(0, 0)

    def epoch_seconds(self, network: NetworkSpec | None = None) -> list[float]:
        """Seconds of an epoch of each level, for a network or for one that sees all categories."""
        folders = {self._layout.budget.folder(category) for category in network.without} if network else set()
        n_train, n_val = (sum(n for (split, category), n in self._by_category.items()
                              if split == wanted and category not in folders) for wanted in ("train", "val"))
        return [n_train * sample + n_val * validation for sample, validation in zip(
            self._rates.train_sample, self._rates.train_validation, strict=True)]

    def _generation(self, spec: InputSpec) -> Estimate:
        share = len(spec.encodings) / self._rates.encodings
        sample = sum(seconds * (share if stage == "fuse inputs" else 1)
                     for stage, seconds in self._rates.generate.items() if stage != "fixed")
        n = sum(self._counts.values())
        size = sum(size for part, size in self._rates.members.items()
                   if part == "target" or part in map(str, spec.encodings))
        at_once = min(self._jobs, max(1, n // _SHARD))
        return Estimate(self._rates.generate["fixed"] + n * sample / at_once, n * size)


def epochs_within(hours: float, epoch_seconds: Sequence[float], fixed: float,
                  paper: Sequence[int]) -> list[int]:
    """Epochs of each level that a network's training time holds, in the proportions of the paper's.

    Raises:
        OcnfError: code `budget`: it does not hold one of each.
    """
    left = hours * 3600 - fixed
    whole = sum(epochs * seconds for epochs, seconds in zip(paper, epoch_seconds, strict=True))
    epochs = [int(left / whole * one) for one in paper]
    if min(epochs) < 1:
        least = max(1 / one for one in paper) * whole + fixed
        raise OcnfError("the budget is too small for one epoch of each level", code="budget", field="--hours",
                        found=f"{hours:g}", expected=f"at least {least / 3600:.3g} for each network",
                        fix="give more hours, fewer meshes or fewer levels")
    return epochs


def read_rates(layout: Layout, device: str) -> Rates | None:
    """What an earlier calibration measured for these resolutions and settings; None where there was none."""
    try:
        return validate(Rates, _known(layout)[_key(layout.budget, device)], Store(layout.out).where(FILE))
    except (KeyError, OcnfError):
        return None  # measured again


def _known(layout: Layout) -> dict[str, Any]:
    """All that earlier calibrations measured; nothing where the file is damaged."""
    store = Store(layout.out)
    if not store.exists(FILE):
        return {}
    try:
        known = json.loads(store.read_bytes(FILE))
    except (ValueError, RecursionError):
        return {}
    return known if isinstance(known, dict) else {}


def calibrate(layout: Layout, root: Path, device: str, console: Console,
              tables: Sequence[TableSpec]) -> Rates:
    """Measure, and keep the result in `rates.json`.

    Args:
        layout: where the folder is, and the budget.
        root: the folder of the meshes or scans.
        device: where networks are trained and run.
        console: where it is said that this goes on.
        tables: what is planned; the input with most encodings and views is measured.

    Raises:
        OcnfError: whatever the pipeline refuses.
    """
    console.print("calibrating: the pipeline on a few meshes", highlight=False)
    layout.out.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=".calibration-", dir=layout.out))
    try:
        rates = _measure(layout.budget, root, folder, device, tables)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    known = {**_known(layout), _key(layout.budget, device): rates.model_dump(mode="json")}
    Store(layout.out).put_bytes(FILE, canonical_json(known, indent=1))
    return rates


def _key(budget: Budget, device: str) -> str:
    settings = budget.with_epochs([1]).settings.decisive()
    kind = ["scans"] if budget.of_scans else []
    return sha256_hex(canonical_json([settings, list(budget.categories), device, *kind]))[:16]


def _measure(budget: Budget, root: Path, out: Path, device: str, tables: Sequence[TableSpec]) -> Rates:
    n = len(budget.categories)
    taken = min(n, _MOST_CATEGORIES)
    chosen = tuple(budget.categories[i * n // taken] for i in range(taken))
    small = replace(budget, categories=chosen, train=1, val=1, test=1, stand_ins={},
                    weight_models=_WEIGHT_MODELS)
    layout = Layout(out, small.with_epochs([2]), listed(small, root), {})
    quiet = Console(quiet=True)
    executor = Executor(layout, root, device, 1, quiet)
    inputs = {name: layout.input(name, spec) for table in tables for name, spec in table.inputs.items()}
    name, spec = max(inputs.items(), key=lambda one: (len(one[1].encodings), one[1].views, one[0]))
    network = NetworkSpec(input=name, encoding=Encoding.HISTOGRAM)
    data = out / "data" / layout.data(name, spec)
    run = layout.run(network, spec)

    wall = _seconds(lambda: executor.do(Step(StepKind.GENERATE, name, f"data/{data.name}/dataset.json", name,
                                             spec)))
    stages, samples = _stages(data)
    members: Counter[str] = Counter()
    summary = describe(str(data))
    for member in summary.members.values():
        part = "target" if member.name == JSON else (parse_member(member.name)[1] or "target")
        members[str(part)] += member.size + 1024 * member.count  # a tar's header, and padding
    settings = layout.budget.network_settings(network)
    epoch, fixed = _train(data, out / "runs", settings, device)
    levels = range(settings.levels)
    sample = [max((many - few) / (_MANY - _FEW), 0.3 * many / _MANY) for few, many in epoch]
    validation = [max(epoch[i][1] - _MANY * sample[i], 0.0) / len(chosen) for i in levels]
    (out / "runs" / str(_MANY)).rename(out / "runs" / run)
    timed = {kind: _rate(executor, Step(kind, name, f"{kind}/x/x", name, spec, network), len(chosen))
             for kind in (StepKind.EVALUATE, StepKind.TIME)}
    weights = Path("weights") / f"{layout.weighed(data.name)}.json"
    run_choose_weight(str(data), out=out / weights, resolutions=small.resolutions[:1], n_models=1)  # compile
    weigh = _seconds(lambda: executor.do(Step(StepKind.CHOOSE_WEIGHT, name, str(weights), name, spec)))
    choices = json.loads((out / weights).read_bytes())["choices"]
    weigh *= _WEIGHTS * len(choices) / sum(len(one["weights"]) for one in choices)
    baselines = _rate(executor, Step(StepKind.BASELINES, name, "baselines/x/x", name, spec), len(chosen))
    return Rates(
        generate={**stages, "fixed": max(0.0, wall - sum(stages.values()) * samples)},
        encodings=len(spec.encodings), members={part: size / samples for part, size in members.items()},
        train_sample=tuple(sample), train_validation=tuple(validation), train_fixed=fixed,
        run_bytes=folder_size(out / "runs" / run),
        weigh=weigh / min(_WEIGHT_MODELS, len(chosen)), baselines=baselines,
        evaluate=timed[StepKind.EVALUATE], time=timed[StepKind.TIME])


def _rate(executor: Executor, step: Step, n: int) -> float:
    """Seconds a model of a step that goes over all of them, once what it uses is compiled."""
    executor.limit = 1
    executor.do(step)
    executor.limit = None
    return _seconds(lambda: executor.do(step)) / n


def _train(data: Path, out: Path, settings: TrainSettings, device: str
           ) -> tuple[list[tuple[float, float]], float]:
    """Seconds of the second epoch of each level with few and with many samples; of the rest of a step."""
    seconds: dict[int, list[float]] = {}
    fixed = 0.0
    for n in (_FEW, _MANY):
        short = read_settings({**settings.to_dict(), "samples_per_epoch": n}, "the calibration")
        wall = _seconds(lambda: train(str(data), out / str(n), short,  # noqa: B023
                                      device=device, console=Console(quiet=True)))
        with (out / str(n) / CURVES).open(newline="") as file:
            rows = list(csv.DictReader(file))
        seconds[n] = [float(row["seconds"]) for row in rows if row["epoch"] == "2"]
        fixed = wall - sum(float(row["seconds"]) for row in rows)
    return list(zip(seconds[_FEW], seconds[_MANY], strict=True)), max(fixed, 0.0)


def _stages(data: Path) -> tuple[dict[str, float], int]:
    """Mean seconds a sample of each stage, without its slowest one; and the number of samples.

    The slowest is the first that a worker makes, which loads what is compiled: that counts once for a step.
    """
    found: defaultdict[str, list[float]] = defaultdict(list)
    for path in (data / "timings").glob("*.json"):
        for stages in json.loads(path.read_bytes()).values():
            for stage, seconds in stages.items():
                found[stage].append(seconds)
    means = {stage: sum(sorted(all_)[:-1]) / max(1, len(all_) - 1) for stage, all_ in found.items()}
    return means, max(map(len, found.values()))


def folder_size(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _seconds(do: Callable[[], object]) -> float:
    begin = time.perf_counter()
    do()
    return time.perf_counter() - begin
