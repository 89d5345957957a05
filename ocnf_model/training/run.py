"""Training a network stage by stage, resumable at any moment (SEMANTICS 5).

    RUN/settings.json          all settings, resolved, what they were resolved against (see `record`)
    RUN/state.safetensors      where the run is (see `training.train_state`)
    RUN/level-1.safetensors    best checkpoint of each level, by `best_by` of the settings (see `checkpoint`)
    RUN/curves.csv             a line an epoch
    RUN/tensorboard/           the curves by step
    RUN/validation/            the data set that a manifest's validation split was made into
    RUN/cache/                 ground truth that epochs share, where a manifest says so, while the run lasts;
                               may be deleted

>>> train("out", "run", TrainSettings(levels=2))           # doctest: +SKIP
>>> load_run("run")                                        # doctest: +SKIP
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from rich.console import Console
from torch import Tensor

from ocnf_data.files.lock import exclusive
from ocnf_data.files.storage import Store
from ocnf_model.checkpoint import load_level
from ocnf_model.devices import memory_errors
from ocnf_model.header import TrainingData
from ocnf_model.network import Normaliser, OctNetFusion, Output, widths_at
from ocnf_model.training.beginning import check_start, first_network, like_the_start, start_checksums
from ocnf_model.training.curves import Reporter, write_curves
from ocnf_model.training.data import CACHE, DataSource, MixedData, StoredData, open_data
from ocnf_model.training.effects import refuse_extra_channels, refuse_without_effect
from ocnf_model.training.epochs import changed_epochs, check_epochs, write_epochs
from ocnf_model.training.record import (
    RunRecord,
    is_begun,
    read_record,
    refuse_another_run,
    refuse_strangers,
    write_record,
)
from ocnf_model.training.resume import check_state
from ocnf_model.training.settings import TrainSettings, read_settings
from ocnf_model.training.stage import Job, Trainer
from ocnf_model.training.train_state import TrainState, load_state, save_state
from ocnf_model.training.world import World, join_world


def train(data: str | Path | DataSource, out: str | Path,
          settings: TrainSettings | Mapping[str, Any] | None = None, *, device: str = "auto",
          console: Console | None = None, meshes: str | Path | None = None, val: str | Path | None = None,
          ) -> OctNetFusion:
    """Train all levels, or go on where an earlier call with the same arguments, or other epochs, stopped.

    Under `torchrun` all processes train together, each with batches of `batch_size`.

    Args:
        data: a data set that `generate` made, a folder or an fsspec URL; or a manifest (.yaml), whose samples
            are drawn as they are needed; or any other `DataSource`.
        out: folder of the run; a new one, or one begun with these settings.
        settings: the settings, or their fields as in a file; None for the paper's.
        device: `auto`, `cpu`, `cuda`, `cuda:1`.
        console: where the progress is shown; None for the terminal's error stream.
        meshes: the folder that a manifest's mesh paths are relative to.
        val: a data set whose split `val` is to be validated with, instead of that of `data`.

    Returns:
        The network with the best weights of every level, in evaluation mode, on the device.

    Raises:
        OcnfError: the data set lacks what is asked for, the folder belongs to another run, the run to start
            from is another network, memory runs out, a loss is not finite, ...
    """
    folder = Path(out)
    console = console or Console(stderr=True, emoji=False)
    if not isinstance(settings, TrainSettings):
        settings = read_settings(settings or {}, "settings")
    check_start(folder, settings)
    asked = like_the_start(settings)
    with join_world(device) as world:
        if isinstance(data, str | Path):
            refuse_extra_channels(asked)
            source = open_data(str(data), asked, None if meshes is None else Path(meshes),
                               None if val is None else str(val))
        else:
            source = data
        named = asked.variant
        asked = source.with_variant(asked) if isinstance(source, StoredData) else asked
        settings = asked.resolved(source.manifest, None, source.where)
        if not is_begun(folder):
            refuse_without_effect(settings)
            if isinstance(source, MixedData):
                source.refuse_idle()
        if world.is_main:
            _prepare(source, folder, settings, console)
        world.wait()
        for level in range(settings.levels):  # whatever is missing is said before hours of training
            variant = source.validation(folder, settings, level).variant
        source.training(folder, settings, settings.levels - 1)
        settings = asked.resolved(source.manifest, asked.variant or variant, source.where)
        if world.is_main:
            _say_variants(console, named, settings.variant, variant)
        network, n_started = first_network(settings)
        with exclusive(Store(folder)) if world.is_main else nullcontext():
            place = _begin(source, folder, settings, network) if world.is_main else None
            world.wait()
            return _run(source, folder, settings, network.to(world.device), n_started, world, console,
                        place or load_state(folder, note=False))


def _prepare(source: DataSource, folder: Path, settings: TrainSettings, console: Console) -> None:
    """Let the data make what it needs in the folder, if that is a run's or may become one."""
    if isinstance(source, StoredData):
        return
    with exclusive(Store(folder)):
        refuse_strangers(folder)
        source.prepare(folder, settings, console)


def _say_variants(console: Console, named: str | None, training: str | None, validation: str | None) -> None:
    """Say which inputs are read, where that is not what the settings name or one of two names."""
    if named is not None and training != named:
        console.print(f"training on the inputs {training}: the data set has no {named}", highlight=False,
                      markup=False)
    if validation != training:
        console.print(f"validating with the inputs {validation}: the data set that is validated with has no "
                      f"{training}", highlight=False, markup=False)


def _run(source: DataSource, folder: Path, settings: TrainSettings, network: OctNetFusion, n_started: int,
         world: World, console: Console, place: tuple[TrainState, dict[str, Tensor]]) -> OctNetFusion:
    assert settings.output is not None and settings.resolutions is not None  # resolved
    training_data = _training_data(source, folder, settings)
    state, tensors = place
    if world.is_main and state.rows:
        write_curves(folder, state.rows)  # a killed run may have left a line too few
    for level in range(settings.levels):
        if level >= state.level:
            if level >= max(n_started, 1):
                _start_level(network, level, world, console)
            job = Job(folder, settings, network, source.training(folder, settings, level),
                      source.validation(folder, settings, level), training_data,
                      source.manifest["target"], world)
            unit = " mm" if settings.output is Output.TSDF else ""
            with memory_errors(f"level {level + 1}", _less_memory(settings, level)), \
                    Reporter(folder, level + 1, settings.resolutions[level], state.steps, unit,
                             world.is_main, console) as report:
                Trainer(job, state, tensors, report).run()
            if level + 1 < settings.levels:  # the last one's state stays: it may be given more epochs
                state, tensors = TrainState(level=level + 1, rows=state.rows), {}
                if world.is_main:
                    save_state(folder, state)
            world.wait()
        load_level(folder, network, level)
    if world.is_main:  # more epochs would make anew what they need of it
        shutil.rmtree(folder / CACHE, ignore_errors=True)
    return network.eval()


def _start_level(network: OctNetFusion, level: int, world: World, console: Console) -> None:
    """Begin a level with the weights of the one before, and say where it cannot."""
    left = network.start_from_previous(level)
    if world.is_main and any(not name.startswith("first.") for name in left):  # which reads other channels
        console.print(f"level {level + 1} has {network.widths(level)} channels where the one before has "
                      f"{network.widths(level - 1)}: what differs begins with random weights",
                      highlight=False, markup=False)


def _training_data(source: DataSource, folder: Path, settings: TrainSettings) -> TrainingData:
    training, validation = source.training(folder, settings, 0), source.validation(folder, settings, 0)
    manifest = source.manifest
    return TrainingData(
        name=manifest["name"], checksum=training.checksum, variant=settings.variant,
        n_train=training.n_samples, n_val=validation.n_samples, extent=manifest["normalise"]["extent"],
        truncation_voxels=manifest["truncation_voxels"])


def _begin(source: DataSource, folder: Path, settings: TrainSettings, network: OctNetFusion
           ) -> tuple[TrainState, dict[str, Tensor]]:
    """Write down what the run is, once nothing speaks against its going on; refuse anything else's folder.

    Returns:
        The state that it goes on from, with its tensors, as `load_state`.
    """
    ours = RunRecord(settings, _training_data(source, folder, settings),
                     source.validation(folder, settings, 0).checksum, start_checksums(settings),
                     apart=settings.samples_per_epoch is not None)
    if not is_begun(folder):
        refuse_strangers(folder)
        write_record(folder, ours)
        return load_state(folder)
    begun = read_record(folder)
    changed = changed_epochs(settings, begun.settings)
    refuse_another_run(folder, ours, begun, but_epochs=bool(changed))
    state, tensors = load_state(folder)
    check_epochs(folder, changed, state)
    training = source.training(folder, settings, state.level) if state.level < settings.levels else None
    check_state(folder, settings, network, training, state, tensors)
    if changed:
        write_epochs(folder, settings, changed, state)
    return state, tensors


def _less_memory(settings: TrainSettings, level: int) -> str:
    """What to lower when memory runs out."""
    stage = settings.stage(level)
    ways = [f"a smaller batch_size (now {stage.batch_size}) with more accumulate "
            f"(now {stage.accumulate})"] if stage.batch_size > 1 else []
    ways += [] if settings.checkpointing or settings.normalise is Normaliser.BATCH else ["--checkpointing"]
    ways += [] if settings.precision == "bfloat16" else ["--precision bfloat16"]
    own = level < len(settings.level_channels or ())
    now = widths_at(level, settings.channels, settings.level_channels)
    ways += [f"smaller {'level_channels' if own else 'channels'} (now {now}) or fewer levels"]
    return f"try {', or '.join(ways)}"
