"""The network that a training begins with: a new one, or one with the weights of another run."""

from __future__ import annotations

from pathlib import Path

import torch
from torch.nn.functional import pad

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import (
    checkpoint_path,
    checkpoint_sha256,
    level_architecture,
    load_level,
    run_folder,
    trained_levels,
)
from ocnf_model.header import Architecture
from ocnf_model.network import (
    Carry,
    Normaliser,
    OctNetFusion,
    fold_normalisation,
    reading_wider,
    widened,
)
from ocnf_model.ops import FusionBlend
from ocnf_model.training.record import is_begun, read_record
from ocnf_model.training.settings import TrainSettings, read_settings
from ocnf_model.training.train_state import has_weights, load_state

_READS = "first.0.weight"


def like_the_start(settings: TrainSettings) -> TrainSettings:
    """The settings; the architecture, where they do not say it, is that of the run that they start from.

    Raises:
        OcnfError: that run is missing or damaged, or what they say does not go together with what it is.
    """
    if settings.start is None:
        return settings
    there = level_architecture(run_folder(settings.start), 0)
    there = there.model_copy(update={"finer": min(there.finer, settings.levels)})
    taken = {name: value for name, value in there.model_dump(mode="json").items()
             if name not in settings.model_fields_set}
    if taken.get("level_channels"):
        taken["level_channels"] = taken["level_channels"][:settings.levels]
        if len(taken["level_channels"]) == settings.levels:
            taken.pop("channels", None)  # they would be no level's
    return read_settings({**settings.to_dict(), **taken}, f"settings as in {settings.start}")


def start_checksums(settings: TrainSettings) -> tuple[str, ...] | None:
    """SHA-256 of the checkpoints that levels begin with, coarse to fine; None without a run to start from."""
    if settings.start is None:
        return None
    folder = run_folder(settings.start)
    n_started = min(trained_levels(folder), settings.levels)
    return tuple(checkpoint_sha256(folder, level) for level in range(1, n_started + 1))


def check_start(folder: Path, settings: TrainSettings) -> None:
    """Refuse to go on where levels that have yet to begin would begin with other weights than at first.

    The run to start from is read anew at every start of this one, and may have been trained on, overwritten,
    or come with another version of the package meanwhile. What it was is of no concern to levels that have
    begun: their weights are in the state. It comes before all else that is compared, as the architecture is
    read from there too.

    Args:
        folder: folder of the run that is gone on with; nothing is compared where none was begun there.
        settings: what this start was asked for.

    Raises:
        OcnfError: code `misfit`, with the level.
    """
    if settings.start is None or not is_begun(folder):
        return
    begun = read_record(folder)
    if begun.start is None or begun.settings.start != settings.start:
        return
    state, tensors = load_state(folder, note=False)
    there = start_checksums(begun.settings) or ()
    for level in range(state.level + has_weights(tensors), max(len(there), len(begun.start))):
        found, expected = (_checksum(sums, level) for sums in (there, begun.start))
        if found != expected:
            path = checkpoint_path(run_folder(settings.start), level + 1)
            raise OcnfError("the run to start from has changed, and the level has yet to begin with its "
                            "weights", code="misfit", where=folder, field=f"start, level {level + 1}",
                            found=f"{path} {found}", expected=expected,
                            fix="put back what was there when this run was begun (for a network that comes "
                                "with ocnf: install the version of then), or begin a new run")


def _checksum(sums: tuple[str, ...], level: int) -> str:
    return f"with SHA-256 {sums[level][:12]}" if level < len(sums) else "that is not there"


def first_network(settings: TrainSettings) -> tuple[OctNetFusion, int]:
    """The network before training, and how many levels have the weights of the run that it starts from.

    That run's network may lack a blend, or the first level's context: they begin as new ones do. Fewer of its
    levels may read a finer encoding: what it adds counts for nothing at first. Its levels may have fewer
    channels: they are widened as the same function. And it may have batch normalisation where this one has
    none: that is folded into its convolutions.

    Raises:
        OcnfError: the run to start from is missing, damaged or of another network.
    """
    torch.manual_seed(settings.seed)
    network = Architecture.of(settings).network(settings.levels, settings.checkpointing)
    for module in network.modules():
        if isinstance(module, FusionBlend):
            module.begin_at(settings.blend_from)
            module.gate.requires_grad_(settings.blend_learns)
    if settings.start is None:
        return network, 0
    folder = run_folder(settings.start)
    n_started = min(trained_levels(folder), settings.levels)
    for level, own in zip(range(n_started), network.levels, strict=False):
        given = _given_level(folder, settings, level)
        weights = given.levels[level].state_dict()
        if network.normalise is Normaliser.NONE:
            weights = fold_normalisation(weights)
        before, after = given.widths(level), network.widths(level)
        if before != after:
            weights = widened(weights, before, after, settings.seed)
        carried, wider = given.widths(level - 1)[0], network.widths(level - 1)[0]
        if level and carried != wider and network.carry is Carry.FEATURES:
            weights[_READS] = reading_wider(weights[_READS], carried, wider, settings.seed)
        new = own.state_dict()[_READS].shape[1] - weights[_READS].shape[1]  # channels, without a say at first
        weights[_READS] = pad(weights[_READS], (0, 0, 0, 0, 0, 0, 0, new))  # (C_out, C_in, 3, 3, 3)
        own.load_state_dict(weights, strict=False)  # `load_level` has seen to it that nothing else lacks
    return network, n_started


def _given_level(folder: Path, settings: TrainSettings, level: int) -> OctNetFusion:
    """A level (from 0) of the run to start from, in a network: as the settings say, but for what may lack."""
    wanted, there = Architecture.of(settings), level_architecture(folder, level)
    may_begin = level < wanted.finer or level >= there.finer  # to read one resolution more, or not to
    widths = there if _widens(there, wanted, level) else wanted
    network = wanted.model_copy(update={
        "blend": wanted.blend and there.blend,
        "context": wanted.context if there.context else 0,
        "finer": there.finer if may_begin else wanted.finer,
        "normalise": there.normalise if wanted.normalise is Normaliser.NONE else wanted.normalise,
        "channels": widths.channels,
        "level_channels": widths.level_channels,
    }).network(level + 1)
    load_level(folder, network, level)
    return network


def _widens(there: Architecture, wanted: Architecture, level: int) -> bool:
    """Whether a level (from 0) and the one it reads have at least the channels of the run to start from."""
    pairs = [(there.widths(one), wanted.widths(one)) for one in range(max(level - 1, 0), level + 1)]
    return all(a == b or (not wanted.residual and a >= b)
               for before, after in pairs for b, a in zip(before, after, strict=True))
