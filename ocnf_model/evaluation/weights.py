"""TV-L1's weights: chosen on the validation split, kept in a file, read by evaluation.

    {"schema": 1, "data": IDENTITY, "split": "val", "choices": [{"variant": "v4_n02", "resolution": 64,
      "weight": 1.6, "weights": [0.4, ...], "mean_mm": [0.71, ...], "models": ["chair_0001", ...]}, ...]}
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.files.targets import check_file
from ocnf_model.baselines import WeightChoice, choose_weight
from ocnf_model.baselines.crossval import CANDIDATE_WEIGHTS
from ocnf_model.evaluation.models import DatasetFacts, Models

_SCHEMA = 1
_MAX_BYTES = 2**24
_LARGEST_NUMBER_OF_MODELS = {64: 20, 128: 10}  # and 5 from 256 on


@dataclass(frozen=True)
class WeightRecord:
    """The best weight of a variant at a resolution, and how it came about."""

    variant: str
    resolution: int
    weight: float
    weights: list[float]
    mean_mm: list[float]
    models: list[str]


def run_choose_weight(data: str, *, out: Path, resolutions: Sequence[int] | None = None,
                      n_models: int | None = None, split: str = "val",
                      weights: Sequence[float] = CANDIDATE_WEIGHTS,
                      console: Console | None = None) -> list[WeightRecord]:
    """Choose TV-L1's weight for each variant with histograms, and write the file that evaluation reads.

    Args:
        data: a data set whose ground truth is TSDF.
        out: the file to write.
        resolutions: the resolutions to choose a weight for; None for all.
        n_models: how many of the split; None: 20 up to 64^3, 10 at 128^3, 5 above. Fewer if there are fewer.
        split: never the one that is reported on.
        weights: at least 6, ascending; the grid grows where the best lies at its end.
        console: where the progress is shown, and a table after each resolution of each variant; None shows
            none.

    Raises:
        OcnfError: the file cannot be written; the data set lacks histograms, a TSDF, the resolution or the
            split; no grid of weights.
    """
    check_file(out)
    facts = DatasetFacts.read(data)
    if facts.is_occupancy:
        raise OcnfError("the weight is chosen by the TSDF's error", where=data, field="target",
                        found="occupancy", expected="tsdf")
    variants = [name for name, stored in facts.variants.items() if Encoding.HISTOGRAM in stored]
    if not variants:
        raise OcnfError("the data set has no histograms", code="missing", where=data, field="inputs")
    choices = []
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=console is None) as progress:
        for variant in variants:
            for resolution in resolutions or facts.resolutions:
                models, choice = _choose(facts, split, variant, resolution, n_models, weights, progress)
                choices.append(WeightRecord(variant, resolution, choice.weight, choice.weights.tolist(),
                                            choice.mean_mm.tolist(), models))
                if console is not None:
                    console.print(f"TV-L1, {variant} at {resolution}³, {len(models)} models:", choice.table(),
                                  "", sep="\n", highlight=False)
    text = json.dumps({"schema": _SCHEMA, "data": facts.identity, "split": split,
                       "choices": [asdict(one) for one in choices]}, indent=1)
    Store(out.parent).put_bytes(out.name, text.encode())
    return choices


def _choose(facts: DatasetFacts, split: str, variant: str, resolution: int, n_models: int | None,
            weights: Sequence[float], progress: Progress) -> tuple[list[str], WeightChoice]:
    """The models' keys, and the choice on them."""
    wanted = n_models or next((n for most, n in _LARGEST_NUMBER_OF_MODELS.items() if resolution <= most), 5)
    models = list(Models(facts, split, variant, [Encoding.HISTOGRAM], [resolution], wanted))
    task = progress.add_task("", total=len(models))

    def solved(weight: float, model: int, _: float) -> None:
        progress.update(task, completed=model + 1,
                        description=f"{variant} at {resolution}³, weight {weight:.3g}")

    tau = facts.taus.get(resolution, math.nan)
    choice = choose_weight([(model.inputs[Encoding.HISTOGRAM][resolution], model.truths[resolution], tau)
                            for model in models], weights, progress=solved)
    progress.remove_task(task)
    return [model.key for model in models], choice


class ChosenWeights(NamedTuple):
    """What such a file says.

    Attributes:
        weights: by (variant, resolution).
        data: identity of the data set that they were chosen on; None where the file does not say.
    """

    weights: Mapping[tuple[str, int], float]
    data: str | None


def read_weights(path: Path) -> ChosenWeights:
    """The weights in a file that `run_choose_weight` wrote.

    Raises:
        OcnfError: no such file, or not one of weights.
    """
    with storage_errors(path), path.open("rb") as opened:
        text = opened.read(_MAX_BYTES)
    try:
        content = json.loads(text)
        if content["schema"] != _SCHEMA:
            raise ValueError(f"schema {content['schema']}")
        found = {(str(one["variant"]), int(one["resolution"])): float(one["weight"])
                 for one in content["choices"]}
        if not all(math.isfinite(weight) and weight > 0 for weight in found.values()):
            raise ValueError("a weight that is not above 0")
        data = content.get("data")
        if not isinstance(data, str | None):
            raise TypeError("data is not a checksum")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise OcnfError("not a file of TV-L1 weights", code="damaged", where=path,
                        found=f"{type(error).__name__}: {error}", fix="choose them again") from error
    return ChosenWeights(found, data)
