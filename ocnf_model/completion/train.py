"""Training of the completion network: the stages of `training.run`, on single frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from ocnf_data.encodings import Encoding
from ocnf_model.completion.data import CompletionData
from ocnf_model.completion.encoding import CHANNELS
from ocnf_model.completion.sample import LEVELS
from ocnf_model.network import Normaliser, OctNetFusion, Output
from ocnf_model.training.choice import BestBy
from ocnf_model.training.run import train
from ocnf_model.training.settings import Decay, Stage, TrainSettings, load_settings, read_settings

_FIXED: dict[str, Any] = {"encoding": Encoding.TSDF, "extra_channels": CHANNELS - Encoding.TSDF.channels,
                          "output": Output.OCCUPANCY}
"""What the frames are, whatever the settings say."""
_DEFAULTS: dict[str, Any] = {
    "levels": LEVELS, "normalise": Normaliser.BATCH, "residual": True, "best_by": BestBy.IOU,
    "samples_per_epoch": 100, "workers": 0, "save_every": 20,
    "stages": [
        Stage(epochs=20, batch_size=2, accumulate=1, learning_rate=2e-3, decay=Decay.COSINE).model_dump(),
        Stage(epochs=4, batch_size=1, accumulate=1, learning_rate=1e-3, decay=Decay.COSINE).model_dump()]}


def completion_settings(fields: Mapping[str, Any] | None = None,
                        where: object = "completion") -> TrainSettings:
    """The settings of a run; those that `fields` does not name are completion's own defaults.

    Raises:
        OcnfError: a field that is unknown or impossible, by name.
    """
    return read_settings({**_DEFAULTS, **(fields or {}), **_FIXED}, where)


def run_train(data: str, out: Path, *, settings: Path | None = None, synthetic: int = 150,
              device: str = "auto", console: Console | None = None) -> OctNetFusion:
    """Train on synthetic tabletops, fine-tune on those of Voxlets; a run that was stopped goes on.

    Args:
        data: folder of the Voxlets data.
        out: folder of the run.
        settings: a YAML or JSON file with any fields of `TrainSettings`.
        synthetic: number of synthetic scenes.
        device: `auto`, `cpu`, `cuda`.
        console: where progress is shown.
    """
    fields = None if settings is None else load_settings(settings)
    chosen = completion_settings(fields, settings or "completion")
    return train(CompletionData(data, synthetic, chosen.seed), out, chosen, device=device, console=console)
