"""Where a run is: everything that the rest of it depends on, in one file that is replaced whole.

    RUN/state.safetensors     weights of the level in training and their average, Adam's moments, the random
                              state; the header holds the state (level, epoch, step), the loader's state and
                              the curves

It is written at steps of the optimiser, so there are no half accumulated gradients to keep: a run killed
between two states does the steps after the first of them again, with the same result.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from ocnf_data.errors import OcnfError
from ocnf_data.files.validation import Int, Real, Strict, validate
from ocnf_model.header import MAX_COUNT
from ocnf_model.tensorfile import TensorKind, read_tensors, write_tensors
from ocnf_model.training.average import WeightAverage

STATE: Final = "state.safetensors"
_SCHEMA: Final = 1
_WEIGHTS, _AVERAGE, _ADAM, _RANDOM = "weights.", "average.", "adam.", "random."
_MOMENTS = ("exp_avg", "exp_avg_sq")
_ANEW = "put a good copy in its place, or move the run's folder away and start again"


@dataclass(frozen=True)
class EpochRow:
    """A line of the curves.

    Attributes:
        level, epoch: numbers of level and epoch, from 1.
        resolution: voxels along each axis.
        steps: number of optimiser steps in this level so far.
        train_loss: mean over the epoch's samples, each at the weights when it was met.
        val_mad: millimetres, or for occupancy the mean difference of probabilities.
        val_iou: mean over the validation samples.
        seconds: training and validation, since the last start where it was resumed.
        best: whether it is the level's best so far, by the measure of the settings.
        val_f_score: F-score of the surface at one voxel, 0 to 1; None where the version that wrote it did not
            measure it.
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
        level: number of the level, from 0; when all is done it is the last one, whose epochs are all done.
        epoch: number of the epoch, from 0.
        step: batches of the epoch that are done.
        steps: number of optimiser steps in this level so far.
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


_Count = Annotated[Int, Field(ge=0, le=MAX_COUNT)]
_Positive = Annotated[Int, Field(ge=1, le=MAX_COUNT)]
_Total = Annotated[Real, Field(ge=0)]


class _Row(Strict):
    level: _Positive
    epoch: _Positive
    resolution: _Positive
    steps: _Positive
    train_loss: _Total
    val_mad: _Total
    val_iou: Annotated[Real, Field(ge=0, le=1)]
    seconds: _Total
    best: Annotated[bool, Field(strict=True)]
    val_f_score: Annotated[Real, Field(ge=0, le=1)] | None = None


class _Header(Strict):
    """The fields of a `TrainState` as the file has them."""

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    level: _Count
    epoch: _Count
    step: _Count
    steps: _Count
    loss_sum: _Total
    loss_count: _Total
    loader: dict[str, Any] | None
    rows: tuple[_Row, ...]


def save_state(folder: Path, state: TrainState, level: nn.Module | None = None,
               optimiser: torch.optim.Optimizer | None = None, average: WeightAverage | None = None) -> None:
    """Replace the state; without a level between two levels."""
    tensors: dict[str, Tensor] = {_RANDOM + "cpu": torch.get_rng_state()}
    if level is not None and optimiser is not None:
        tensors |= {_WEIGHTS + name: tensor for name, tensor in level.state_dict().items()}
        for name, parameter in level.named_parameters():
            for moment, tensor in optimiser.state.get(parameter, {}).items():
                tensors[f"{_ADAM}{moment}.{name}"] = tensor
    if average is not None:
        tensors |= {_AVERAGE + name: tensor for name, tensor in average.tensors.items()}
    write_tensors(folder / STATE, tensors, {"schema": _SCHEMA, **asdict(state)})


def load_state(folder: Path, note: bool = True) -> tuple[TrainState, dict[str, Tensor]]:
    """The state, and the tensors for `restore`; the beginning where there is no state yet.

    Args:
        folder: folder of the run.
        note: log it where the state has no checksum.

    Raises:
        OcnfError: the state is damaged or of another schema.
    """
    path = folder / STATE
    if not path.is_file():
        return TrainState(), {}
    tensors, fields = read_tensors(path, note=note)
    if fields.get("schema") != _SCHEMA:
        raise OcnfError("the run was begun by another version", code="schema", where=path,
                        fix="finish it with that version, or begin a new run")
    header = validate(_Header, fields, path).model_dump(exclude={"schema_version", "rows"})
    return TrainState(**header, rows=[EpochRow(**row) for row in fields["rows"]]), tensors


def has_weights(tensors: Mapping[str, Tensor]) -> bool:
    """Whether these tensors of a state are those of a level that has begun."""
    return any(name.startswith(_WEIGHTS) for name in tensors)


def check_progress(folder: Path, state: TrainState, epochs: Sequence[int],
                   resolutions: Sequence[int]) -> None:
    """Refuse a state that no run with these settings can reach.

    Args:
        folder: folder of the run.
        state: state of the run.
        epochs: number of epochs of each level, by the settings.
        resolutions: resolution of each level.

    Raises:
        OcnfError: code `damaged`, with the field.
    """
    def refuse(field_name: str, found: object, expected: object) -> OcnfError:
        return OcnfError("the state is of no run with these settings", code="damaged", where=folder / STATE,
                         field=field_name, found=found, expected=expected, fix=_ANEW)

    if state.level > len(epochs):
        raise refuse("level", state.level, f"at most {len(epochs)}")
    most = epochs[state.level] if state.level < len(epochs) else 0
    if state.epoch > most:
        raise refuse("epoch", state.epoch, f"at most {most}")
    done = [*epochs[:state.level], state.epoch]
    expected = [(level, epoch) for level, n in enumerate(done, 1) for epoch in range(1, n + 1)]
    if (found := [(row.level, row.epoch) for row in state.rows]) != expected:
        raise refuse("rows", f"{len(found)} epochs", f"those of {len(expected)}, in order")
    for row in state.rows:
        if row.resolution != resolutions[row.level - 1]:
            raise refuse("rows.resolution", row.resolution, resolutions[row.level - 1])


def check_step(folder: Path, state: TrainState, n_batches: int, accumulate: int, exact: bool) -> None:
    """Refuse a step within the epoch that does not fit the data set, the optimiser's count or the loader.

    Args:
        folder: folder of the run.
        state: state of the run.
        n_batches: number of batches in an epoch.
        accumulate: batches for a step of the optimiser.
        exact: no batch may have been left out, so the optimiser's count is known.

    Raises:
        OcnfError: code `damaged`, with the field.
    """
    steps = state.epoch * -(-n_batches // accumulate) + -(-state.step // accumulate)
    at = state.epoch * n_batches + state.step
    # The end of an epoch is the beginning of the next.
    same = {divmod(at, n_batches), ((at - 1) // n_batches, (at - 1) % n_batches + 1)}
    loader = (0, 0) if state.loader is None else (state.loader.get("epoch"), state.loader.get("step"))
    for field_name, fits, found, expected in (
        ("step", state.step <= n_batches, state.step, f"at most {n_batches}"),
        ("steps", state.steps == steps if exact else state.steps <= steps, state.steps, steps),
        ("loader", loader in same, loader, f"epoch {state.epoch}, step {state.step}"),
    ):
        if not fits:
            raise OcnfError("the state does not fit the data set or the settings", code="damaged",
                            where=folder / STATE, field=field_name, found=found, expected=expected, fix=_ANEW)


def restore(tensors: Mapping[str, Tensor], level: nn.Module, optimiser: torch.optim.Optimizer,
            average: WeightAverage | None = None) -> None:
    """Put weights, their average, moments and random state back; nothing where the level has not begun.

    Raises:
        OcnfError: they do not fit the network.
    """
    weights = _below(tensors, _WEIGHTS)
    if not weights:
        return
    check_tensors(tensors, level, average is not None)
    level.load_state_dict(weights)
    if average is not None:
        average.restore(_below(tensors, _AVERAGE))
    torch.set_rng_state(tensors[_RANDOM + "cpu"])
    moments = _below(tensors, _ADAM)
    for name, parameter in level.named_parameters():
        kept = {key.partition(".")[0]: tensor for key, tensor in moments.items()
                if key.partition(".")[2] == name}
        if kept:  # Adam counts its steps on the CPU
            optimiser.state[parameter] = {moment: tensor if moment == "step" else tensor.to(parameter.device)
                                          for moment, tensor in kept.items()}


def check_tensors(tensors: Mapping[str, Tensor], level: nn.Module, averaged: bool) -> None:
    """Refuse other tensors than weights, averages, moments once there was a step, and the random state.

    Args:
        tensors: tensors of a state; any where the level has not begun.
        level: the level that they are of.
        averaged: whether a running average of the weights is kept.

    Raises:
        OcnfError: code `damaged`, with the tensor.
    """
    if not has_weights(tensors):
        return
    expected = {prefix + name: TensorKind.of(tensor) for name, tensor in level.state_dict().items()
                for prefix in ((_WEIGHTS, _AVERAGE) if averaged else (_WEIGHTS,))}
    if any(name.startswith(_ADAM) for name in tensors):  # none before the first step
        for name, parameter in level.named_parameters():
            if not parameter.requires_grad:
                continue
            expected |= {f"{_ADAM}{moment}.{name}": TensorKind.of(parameter) for moment in _MOMENTS}
            expected[f"{_ADAM}step.{name}"] = TensorKind("F32", ())
    expected[_RANDOM + "cpu"] = TensorKind.of(torch.get_rng_state())
    found = {name: TensorKind.of(tensor) for name, tensor in tensors.items()}
    for name in sorted(expected.keys() | found.keys()):
        if found.get(name) != expected.get(name):
            raise OcnfError("the state does not fit the network", code="damaged", where=STATE, field=name,
                            found=_described(found.get(name)), expected=_described(expected.get(name)),
                            fix=_ANEW)


def _described(kind: TensorKind | None) -> str:
    return "nothing" if kind is None else f"{kind.dtype} {kind.shape}"


def _below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
