"""Where a run is: everything that the rest of it depends on, in one file that is replaced whole.

    RUN/state.safetensors     weights of the level in training, Adam's moments, the random state; the header
                              holds the state (level, epoch, step), the loader's state and the curves

It is written at steps of the optimiser, so there are no half accumulated gradients to keep: a run killed
between two states does the steps after the first of them again, with the same result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor, nn

from ocnf_data.errors import OcnfError
from ocnf_model.tensorfile import read_tensors, write_tensors

STATE: Final = "state.safetensors"
_SCHEMA: Final = 1
_WEIGHTS, _ADAM, _RANDOM = "weights.", "adam.", "random."


@dataclass(frozen=True)
class EpochRow:
    """A line of the curves.

    Attributes:
        level, epoch: from 1.
        resolution: voxels along each axis.
        steps: of the optimiser, in this level so far.
        train_loss: mean over the epoch's samples, each at the weights when it was met.
        val_mad: millimetres, or for occupancy the mean difference of probabilities.
        val_iou: mean over the validation samples.
        seconds: training and validation, since the last start where it was resumed.
        best: whether it is the level's best so far, by the measure of the settings.
        val_f_score: of the surface at one voxel; None of a version that did not measure it.
    """

    level: int
    epoch: int
    resolution: int
    steps: int
    train_loss: float
    val_mad: float
    val_iou: float
    seconds: float
    best: bool
    val_f_score: float | None = None


@dataclass
class TrainState:
    """Where a run is.

    Attributes:
        level: from 0; when all is done it is the last one, whose epochs are all done.
        epoch: from 0.
        step: batches of the epoch that are done.
        steps: of the optimiser, in this level.
        loss_sum, loss_count: over the samples of the epoch met so far.
        loader: state of the training loader; None at the start of a level.
        rows: the curves so far.
    """

    level: int = 0
    epoch: int = 0
    step: int = 0
    steps: int = 0
    loss_sum: float = 0.0
    loss_count: float = 0.0
    loader: dict[str, Any] | None = None
    rows: list[EpochRow] = field(default_factory=list)

    @property
    def best(self) -> EpochRow | None:
        """The best epoch of this level so far."""
        return next((row for row in reversed(self.rows) if row.level == self.level + 1 and row.best), None)


def save_state(folder: Path, state: TrainState, level: nn.Module | None = None,
               optimiser: torch.optim.Optimizer | None = None) -> None:
    """Replace the state; without a level between two levels."""
    tensors: dict[str, Tensor] = {_RANDOM + "cpu": torch.get_rng_state()}
    if level is not None and optimiser is not None:
        tensors |= {_WEIGHTS + name: tensor for name, tensor in level.state_dict().items()}
        for name, parameter in level.named_parameters():
            for moment, tensor in optimiser.state.get(parameter, {}).items():
                tensors[f"{_ADAM}{moment}.{name}"] = tensor
    write_tensors(folder / STATE, tensors, {"schema": _SCHEMA, **asdict(state)})


def load_state(folder: Path) -> tuple[TrainState, dict[str, Tensor]]:
    """The state, and the tensors for `restore`; the beginning where there is no state yet.

    Raises:
        OcnfError: the state is damaged or of another schema.
    """
    path = folder / STATE
    if not path.is_file():
        return TrainState(), {}
    tensors, fields = read_tensors(path)
    if fields.pop("schema", None) != _SCHEMA:
        raise OcnfError("the run was begun by another version", code="schema", where=path,
                        fix="finish it with that version, or begin a new run")
    try:
        state = TrainState(**{**fields, "rows": [EpochRow(**row) for row in fields["rows"]]})
    except (KeyError, TypeError) as error:
        raise OcnfError("not a state of a run", code="damaged", where=path, found=error) from error
    return state, tensors


def restore(tensors: Mapping[str, Tensor], level: nn.Module, optimiser: torch.optim.Optimizer) -> None:
    """Put weights, moments and random state back; nothing where the level has not begun.

    Raises:
        OcnfError: they do not fit the network.
    """
    weights = _below(tensors, _WEIGHTS)
    if not weights:
        return
    try:
        level.load_state_dict(weights)
        torch.set_rng_state(tensors[_RANDOM + "cpu"])
    except (RuntimeError, KeyError) as error:
        raise OcnfError("the state does not fit the network", code="damaged", where=STATE,
                        found=str(error).splitlines()[0]) from error
    moments = _below(tensors, _ADAM)
    for name, parameter in level.named_parameters():
        kept = {key.partition(".")[0]: tensor for key, tensor in moments.items()
                if key.partition(".")[2] == name}
        if kept:  # Adam counts its steps on the CPU
            optimiser.state[parameter] = {moment: tensor if moment == "step" else tensor.to(parameter.device)
                                          for moment, tensor in kept.items()}


def _below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
