"""One stage: the epochs of one level, on the outputs of the frozen levels before it."""

from __future__ import annotations

import math
import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from multiprocessing import AuthenticationError
from pathlib import Path
from types import TracebackType

import numba
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from ocnf_data.errors import OcnfError
from ocnf_data.loading.epochs import EpochDataset
from ocnf_data.octree.bits import TREE_WIDTH
from ocnf_model.checkpoint import checkpoint_sha256, save_checkpoint, torch_version
from ocnf_model.devices import autocast
from ocnf_model.header import Architecture, Header, TrainingData
from ocnf_model.network import LevelOutput, OctNetFusion, Output, freeze_statistics
from ocnf_model.training.average import WeightAverage
from ocnf_model.training.batches import AnyBatch, Example, make_example
from ocnf_model.training.choice import is_better
from ocnf_model.training.crops import crop_losses, draw_corners
from ocnf_model.training.curves import Reporter
from ocnf_model.training.objective import objective, voxel_weights
from ocnf_model.training.settings import TrainSettings
from ocnf_model.training.train_state import EpochRow, TrainState, restore, save_state
from ocnf_model.training.validation import Validation, Validator
from ocnf_model.training.world import World

SAVE_SECONDS = 15 * 60.0
"""The longest that steps go without a saved state: what a power cut costs."""


@dataclass(frozen=True, eq=False)
class Job:
    """What a stage needs.

    Attributes:
        folder: folder of the run.
        settings: resolved.
        network: the network on the device, the levels before this one with their best weights.
        training, validation: samples of this level.
        facts: what the manifest of the data set says.
        target: what the data set holds.
        world: this process among the others.
    """

    folder: Path
    settings: TrainSettings
    network: OctNetFusion
    training: EpochDataset
    validation: EpochDataset
    facts: TrainingData
    target: str
    world: World


class Trainer:
    """Trains the level that a state is in, from there to the level's end.

    Args:
        job: what the stage needs.
        state: where the run is, as `resume` has checked it; kept up to date.
        tensors: tensors of the state that the run resumes from.
        report: shows the progress; called at every step.
    """

    def __init__(self, job: Job, state: TrainState, tensors: dict[str, Tensor], report: Reporter) -> None:
        self._job, self._state, self._report = job, state, report
        self._stage = job.settings.stage(state.level)
        self._level = job.network.levels[state.level]
        self._parameters = [parameter for parameter in self._level.parameters() if parameter.requires_grad]
        self._optimiser = torch.optim.Adam(self._parameters, self._stage.learning_rate,
                                           weight_decay=self._stage.weight_decay)
        self._n_steps = self._stage.epochs * math.ceil(len(job.training) / self._stage.accumulate)
        decay = job.settings.average
        self._average = WeightAverage(self._level, decay) if decay else None
        self._saved = time.monotonic()
        restore(tensors, self._level, self._optimiser, self._average)
        if state.loader is not None:
            job.training.load_state_dict(state.loader)

    def run(self) -> None:
        """All epochs that are left; every one is validated, and the best is kept.

        Raises:
            OcnfError: a loss or gradient is not finite; the last state and the best checkpoint stay.
        """
        state = self._state
        loader = _loader(self._job.training, self._job)
        validation = _loader(self._job.validation, self._job)
        while state.epoch < self._stage.epochs:
            began = time.monotonic()
            if state.step < len(self._job.training):
                self._train(loader)
            self._save()
            with self._average.in_use() if self._average else nullcontext():
                found = self._validate(validation)
                row = self._row(found, time.monotonic() - began)
                if row.best and self._job.world.is_main:
                    save_checkpoint(self._job.folder, self._header(row), self._level.state_dict())
            self._finish_epoch(row, found)

    # ---- training

    def _train(self, loader: DataLoader[AnyBatch]) -> None:
        state, n_batches = self._state, len(self._job.training)
        self._job.training.set_epoch(state.epoch)
        self._report.begin(f"epoch {state.epoch + 1} of {self._stage.epochs}", n_batches, state.step)
        self._job.network.eval()  # the levels before: their normalisation stays as it was trained
        self._level.train()
        if self._stage.freeze_after is not None and state.epoch >= self._stage.freeze_after:
            freeze_statistics(self._level)
        met: list[tuple[AnyBatch, Tensor]] = []
        for batch in loader:
            met.append((batch, self._backward(batch, n_batches)))
            state.step = batch.step + 1
            if state.step % self._stage.accumulate and state.step < n_batches:
                self._report.advance()
                continue
            loss = self._update(met)
            met.clear()
            state.loader = self._job.training.state_dict(batch)
            self._report.advance(f"loss {loss:.5f}")
            self._report.step(state.steps, loss, self._optimiser.param_groups[0]["lr"])
            if state.step < n_batches and self._is_due():
                self._save()

    def _backward(self, batch: AnyBatch, n_batches: int) -> Tensor:
        """Add a batch's share to the gradients; the loss of each sample, (B,)."""
        accumulate = self._stage.accumulate
        group = min(accumulate, n_batches - batch.step // accumulate * accumulate)
        example = self._example(batch)
        settings, output = self._job.settings, self._job.network.output
        loss, weights = objective(settings, output), voxel_weights(settings, output, example)
        if self._stage.crop is None:
            losses = loss(self._forward(example).raw, example.target, "none", weights=weights)
        else:
            size = self._stage.crop // TREE_WIDTH
            corners = draw_corners(example.target.structure, size, settings.seed, batch.epoch, batch.draws,
                                   self._stage.crops)
            with self._precision():
                losses = crop_losses(self._job.network, example, self._state.level, corners, size, loss,
                                     weights)
        (losses.mean() / group).backward()
        return losses.detach()

    def _update(self, met: list[tuple[AnyBatch, Tensor]]) -> float:
        """A step of the optimiser over some batches; their mean loss over all ranks."""
        losses = torch.cat([losses for _, losses in met]).tolist()
        keys = [key for batch, _ in met for key in batch.keys]
        bad = [key for key, loss in zip(keys, losses, strict=True) if not _is_finite(loss)]
        if bad:
            raise self._not_finite("the loss", bad)
        self._job.world.average_gradients(self._parameters)
        norm = torch.nn.utils.clip_grad_norm_(self._parameters, float("inf"))
        if not _is_finite(norm.item()):
            raise self._not_finite("the gradient", keys)
        for group in self._optimiser.param_groups:
            group["lr"] = self._stage.rate(self._state.steps, self._n_steps)
        self._optimiser.step()
        self._job.world.average(self._level.buffers())
        self._optimiser.zero_grad()
        self._state.steps += 1
        if self._average is not None:
            self._average.update(self._state.steps)
        first = [not again for batch, _ in met for again in batch.repeat]
        total, count, everything, n = self._job.world.sum([
            sum(loss for loss, counts in zip(losses, first, strict=True) if counts), sum(first),
            sum(losses), len(losses)])
        self._state.loss_sum += total
        self._state.loss_count += count
        return everything / n

    def _not_finite(self, what: str, keys: list[str]) -> OcnfError:
        return OcnfError(f"{what} is not finite, the run has stopped", code="not_finite",
                         where=self._job.folder,
                         field=f"level {self._state.level + 1}, epoch {self._state.epoch + 1}, "
                               f"batch {self._state.step}", found=f"samples {', '.join(keys)}",
                         fix="the state before it and the best checkpoint are kept: look at these samples, "
                             "or train with a smaller learning_rate or in float32")

    # ---- validation

    @torch.no_grad()
    def _validate(self, loader: DataLoader[AnyBatch]) -> Validation:
        """Means over the validation samples of all ranks."""
        job = self._job
        validator = Validator(job.network.output, job.network.encoding, job.facts.tau(self._resolution))
        self._report.begin("validation", len(job.validation))
        self._level.eval()
        job.validation.set_epoch(0)
        for batch in loader:
            if not len(batch):
                continue
            example = self._example(batch)
            validator.add(self._forward(example).reconstruction.to(dtype=torch.float32), example)
            self._report.advance()
        found = validator.means(job.world.sum)
        if found is None:
            raise OcnfError("no validation sample could be read", code="empty", where=job.folder)
        return found

    def _row(self, found: Validation, seconds: float) -> EpochRow:
        state = self._state
        row = EpochRow(
            level=state.level + 1, epoch=state.epoch + 1, resolution=self._resolution, steps=state.steps,
            train_loss=state.loss_sum / max(state.loss_count, 1), val_mad=found.mad, val_iou=found.iou,
            seconds=round(seconds, 3), best=False, val_f_score=found.f_score)
        return replace(row, best=is_better(row, state.best, self._job.settings.best_by))

    def _finish_epoch(self, row: EpochRow, found: Validation) -> None:
        state = self._state
        state.rows.append(row)
        state.epoch, state.step = state.epoch + 1, 0
        state.loss_sum = state.loss_count = 0.0
        self._save()
        self._report.epoch(state.rows, found)

    def _header(self, row: EpochRow) -> Header:
        job, network = self._job, self._job.network
        return Header(
            level=row.level, resolution=row.resolution,
            architecture=Architecture.of(network),
            data=job.facts, epoch=row.epoch, steps=row.steps,
            metrics={"mad_mm" if network.output is Output.TSDF else "mad": row.val_mad, "iou": row.val_iou,
                     "f_score": row.val_f_score or 0.0, "train_loss": row.train_loss},
            settings=job.settings.decisive(),
            built_on=checkpoint_sha256(job.folder, row.level - 1) if row.level > 1 else None,
            torch=torch_version(),
        )

    # ---- both

    @property
    def _resolution(self) -> int:
        assert self._job.settings.resolutions is not None  # resolved
        return self._job.settings.resolutions[self._state.level]

    def _example(self, batch: AnyBatch) -> Example:
        return make_example(batch, self._job.network.output, self._job.target, self._job.world.device)

    def _forward(self, example: Example) -> LevelOutput:
        with self._precision():
            level = self._state.level
            return self._job.network.run(example.inputs, frozen=level, levels=level + 1)[-1]

    def _precision(self) -> torch.autocast:
        return autocast(self._job.settings.precision, self._job.world.device)

    def _is_due(self) -> bool:
        """Whether it is time for a state; the main rank's clock counts, as it writes alone."""
        return self._state.steps % self._job.settings.save_every == 0 or \
            time.monotonic() - self._saved >= SAVE_SECONDS

    def _save(self) -> None:
        self._saved = time.monotonic()
        if self._job.world.is_main:
            save_state(self._job.folder, self._state, self._level, self._optimiser, self._average)


def _is_finite(value: float) -> bool:
    return abs(value) < float("inf")


def _loader(dataset: EpochDataset, job: Job) -> DataLoader[AnyBatch]:
    workers = job.settings.workers
    return DataLoader(dataset, batch_size=None, num_workers=workers, persistent_workers=workers > 0,
                      pin_memory=job.world.device.type == "cuda", worker_init_fn=use_one_thread)


def use_one_thread(_: int) -> None:
    """Let a loader's worker use one thread, as PyTorch does too: the cores are for the training process."""
    numba.set_num_threads(1)
    sys.excepthook = _report_unless_hung_up


def _report_unless_hung_up(kind: type[BaseException], error: BaseException,
                           traceback: TracebackType | None) -> None:
    """Say nothing of a connection that ends: the training was stopped while a tensor was handed over.

    What fails in a worker's own code is raised in the training process, and does not come by here; the thread
    that hands tensors over (`multiprocessing.resource_sharer`) does.
    """
    if not issubclass(kind, EOFError | OSError | AuthenticationError):
        sys.__excepthook__(kind, error, traceback)
