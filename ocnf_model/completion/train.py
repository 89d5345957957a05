"""Training of the completion network: the stages of `training.run`, on single frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_model.completion.data import CompletionData
from ocnf_model.completion.encoding import CHANNELS
from ocnf_model.completion.predict import CompletionNetwork, choose_threshold, write_threshold
from ocnf_model.completion.sample import LEVELS
from ocnf_model.network import Normaliser, Output
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
        Stage(epochs=8, batch_size=2, accumulate=1, learning_rate=2e-3, decay=Decay.COSINE).model_dump(),
        Stage(epochs=3, batch_size=1, accumulate=1, learning_rate=1e-3, decay=Decay.COSINE).model_dump()]}


def completion_settings(fields: Mapping[str, Any] | None = None,
                        where: object = "completion") -> TrainSettings:
    """The settings of a run; those that `fields` does not name are completion's own defaults.

    Raises:
        OcnfError: a field that is unknown or impossible, by name.
    """
    settings = read_settings({**_DEFAULTS, **(fields or {}), **_FIXED}, where)
    if settings.finer:
        raise OcnfError("a level of the completion network reads its own resolution alone", where=where,
                        field="finer", found=settings.finer, expected=0)
    return settings


def run_completion_training(data: str, out: Path, *, settings: Path | None = None, synthetic: int = 40,
                            device: str = "auto", console: Console | None = None) -> CompletionNetwork:
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
    console = console or Console(stderr=True, emoji=False)
    source = CompletionData(data, synthetic, chosen.seed)
    train(source, out, chosen, device=device, console=console)
    network = CompletionNetwork(out, device)
    frames = track(source.validation_frames, "choosing the threshold", console=console, transient=True)
    threshold, found = choose_threshold(network.probability, (frame.read() for frame in frames))
    write_threshold(out, threshold, found)
    console.print(f"held out: IoU {found.iou:.3f}, precision {found.precision:.3f}, recall "
                  f"{found.recall:.3f} with the threshold {threshold}, the best of them", highlight=False)
    return CompletionNetwork(out, device)
