"""Whether a run can go on from its state: all of it is checked before anything is written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from ocnf_data.errors import OcnfError
from ocnf_data.loading.arguments import OnError
from ocnf_data.loading.epochs import EpochDataset
from ocnf_model.network import OctNetFusion
from ocnf_model.training.settings import TrainSettings
from ocnf_model.training.train_state import TrainState, check_progress, check_step, check_tensors


def check_state(folder: Path, settings: TrainSettings, network: OctNetFusion, training: EpochDataset | None,
                state: TrainState, tensors: Mapping[str, Tensor]) -> None:
    """Refuse a state that a run with these settings, data and processes cannot go on from.

    Args:
        folder: folder of the run.
        settings: resolved, with the epochs that are asked for now.
        network: a network by these settings.
        training: samples of the level that the state is in, for this check alone; None behind the last level.
        state: state of the run.
        tensors: tensors of the state.

    Raises:
        OcnfError: code `misfit` for another number of processes, `damaged` or `state` for anything else, with
            the field.
    """
    assert settings.resolutions is not None  # resolved
    check_progress(folder, state, [settings.stage(level).epochs for level in range(settings.levels)],
                   settings.resolutions)
    if training is None:
        return
    _check_processes(folder, state, training)  # before what a batch's place is: it differs where they do
    check_step(folder, state, len(training), settings.stage(state.level).accumulate,
               exact=settings.on_error is OnError.RAISE)
    check_tensors(tensors, network.levels[state.level], averaged=bool(settings.average))
    if state.loader is not None:
        training.load_state_dict(state.loader)


def _check_processes(folder: Path, state: TrainState, training: EpochDataset) -> None:
    """Refuse another number of processes than the level is being trained by."""
    expected = None if state.loader is None else state.loader.get("world_size")
    found = training.state_dict().get("world_size")
    if not isinstance(expected, int) or expected == found:
        return
    command = f"torchrun --nproc-per-node {expected} -m ocnf_model.cli train" if expected > 1 \
        else "ocnf-model train, without torchrun"
    raise OcnfError("the level was begun by another number of processes, with other batches",
                    code="misfit", where=folder, field="processes", found=found, expected=expected,
                    fix=f"go on with as many as before: {command}")
