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
from ocnf_model.completion.sample import LEVELS, SIZE
from ocnf_model.network import Normaliser, Output
from ocnf_model.training.choice import BestBy
from ocnf_model.training.effects import no_effect
from ocnf_model.training.record import is_begun
from ocnf_model.training.run import train
from ocnf_model.training.schedule import Decay, Stage
from ocnf_model.training.settings import TrainSettings, load_settings, read_settings

_FIXED: dict[str, Any] = {"encoding": Encoding.TSDF, "extra_channels": CHANNELS - Encoding.TSDF.channels,
                          "output": Output.OCCUPANCY}
"""What the frames are, whatever the settings say."""
_DEFAULTS: dict[str, Any] = {
    "levels": LEVELS, "normalise": Normaliser.BATCH, "residual": True, "best_by": BestBy.IOU,
    "samples_per_epoch": 100, "workers": 0, "save_every": 20,
    "stages": [
        Stage(epochs=8, batch_size=2, accumulate=1, learning_rate=2e-3, decay=Decay.COSINE).model_dump(),
        Stage(epochs=3, batch_size=1, accumulate=1, learning_rate=1e-3, decay=Decay.COSINE).model_dump()]}
_WITHOUT_EFFECT = {
    "augment": "frames are turned about the vertical and mirrored, in eight ways, whatever it is",
    "categories": "frames have no categories",
    "mixture": "real and synthetic frames are mixed as completion does it",
    "on_error": "no frame is left out: one that is damaged can be made again",
    "shuffle_buffer": "frames are drawn, each from all of them",
    "train_split": "the training split is trained on, but for every sixth scene",
    "val_split": "every sixth scene of the training split is validated with",
    "variant": "frames have inputs of one kind",
}
"""Settings of training that completion has no use for, and why."""


def completion_settings(fields: Mapping[str, Any] | None = None, where: object = "completion",
                        begun: bool = False) -> TrainSettings:
    """The settings of a run; those that `fields` does not name are completion's own defaults.

    Args:
        fields: any fields of `TrainSettings`; one that completion has no use for only with its default.
        where: where they come from, for messages.
        begun: whether the run was begun: earlier versions let pass what has no effect.

    Raises:
        OcnfError: a field that is unknown, impossible or of no effect, by name.
    """
    given = fields or {}
    settings = read_settings({**_DEFAULTS, **given, **_FIXED}, where)
    if settings.finer:
        raise OcnfError("a level of the completion network reads its own resolution alone", where=where,
                        field="finer", found=settings.finer, expected=0)
    if not begun:
        _refuse_without_effect(settings, given, where)
    return settings


def _refuse_without_effect(settings: TrainSettings, given: Mapping[str, Any], where: object) -> None:
    """Refuse a field that would change nothing; what a run writes down, which has them all, is let pass."""
    resolutions = tuple(SIZE >> (LEVELS - 1 - level) for level in range(min(settings.levels, LEVELS)))
    checks = [(name, reason, getattr(settings, name), TrainSettings.model_fields[name].default)
              for name, reason in _WITHOUT_EFFECT.items()]
    checks += [(name, "that is what the frames are, whatever it is", given.get(name) or fixed, fixed)
               for name, fixed in _FIXED.items()]
    checks.append(("resolutions", "frames are octrees of certain resolutions, whatever it is",
                   settings.resolutions or resolutions, resolutions))
    for name, reason, found, expected in checks:
        if found != expected:
            raise no_effect(name, reason, where, found, "null" if expected is None else expected,
                            "leave it out")


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
    chosen = completion_settings(fields, settings or "completion", is_begun(Path(out)))
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
