"""What all loaders share: epochs, their batches dealt out to worker processes, and states to resume from.

Batches are formed here, so the `DataLoader` gets `batch_size=None`. Worker w of W makes the batches
s + w, s + w + W, ... from the start s on, and the `DataLoader` takes one of each in turn: they arrive in the
same order for any number of workers (as long as its `in_order` is left on).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import torch.distributed
from torch.utils.data import IterableDataset, get_worker_info

from ocnf_data.errors import OcnfError, whole_from_worker
from ocnf_data.loading.arguments import place_among_ranks, whole
from ocnf_data.loading.batch import Batch
from ocnf_data.loading.cursor import Cursor, Identity, Position
from ocnf_data.loading.loader_state import make_state, read_state
from ocnf_data.loading.order import Partition


class Placed(Protocol):
    """A batch that knows its place."""

    @property
    def epoch(self) -> int:
        """The epoch it belongs to."""

    @property
    def step(self) -> int:
        """Its number in the epoch, on its rank."""


class EpochDataset(IterableDataset[Batch]):
    """Batches in epochs; `_batches` makes them and `_order` says all that they depend on.

    Args:
        partition: which samples of an epoch make which batch of this rank.
    """

    def __init__(self, partition: Partition) -> None:
        self._partition = partition
        self._cursor = Cursor()
        self._rounds = 0

    def __len__(self) -> int:
        """Batches of this rank in a whole epoch (an epoch resumed at step s has s fewer)."""
        return self._partition.n_batches

    def __iter__(self) -> Iterator[Batch]:
        # Not a generator itself: the epoch is claimed now, not at the first batch.
        worker = get_worker_info()
        if worker is None:
            position = self._cursor.claim()
            self._rounds += 1
            return self._batches(position.epoch, range(position.step, len(self)))
        identity = Identity(worker.seed - worker.id, self._rounds, self._cursor.generation,
                            worker.num_workers)
        with whole_from_worker():
            position = self._cursor.claim(worker.id, identity)
        self._rounds += 1
        steps = range(position.step + worker.id, len(self), worker.num_workers)
        return _of_worker(self._batches(position.epoch, steps))

    @abstractmethod
    def _batches(self, epoch: int, steps: range) -> Iterator[Batch]:
        """These batches of an epoch."""

    @abstractmethod
    def _order(self) -> dict[str, Any]:
        """All that batch i of an epoch depends on, as JSON values."""

    @property
    @abstractmethod
    def checksum(self) -> str:
        """SHA-256 of the data that samples come from."""

    @property
    def variant(self) -> str | None:
        """Name of the inputs; None where they have none."""
        return None

    @property
    def n_samples(self) -> int:
        """Samples in an epoch, of all ranks together."""
        return self._partition.n_samples

    # ---- epochs and states

    @property
    def epoch(self) -> int:
        """The epoch that the next `iter` begins."""
        return self._cursor.peek()[0].epoch

    def set_epoch(self, epoch: int) -> None:
        """Let the next `iter` begin this epoch; a state just loaded that lies in it keeps its place."""
        epoch = whole("epoch", epoch, least=0, where=type(self).__name__)
        position, resumed = self._cursor.peek()
        if not (resumed and position.epoch == epoch):
            self._cursor.set(Position(epoch, 0))

    def state_dict(self, batch: Placed | None = None) -> dict[str, Any]:
        """The state after a batch, whatever was prefetched beyond it; before the next `iter` if None. JSON.

        All ranks have the same state after the same step, except with uneven="exact", where each has its own.
        """
        if batch is None:
            position = self._cursor.peek()[0]
        elif batch.step + 1 < len(self):
            position = Position(batch.epoch, batch.step + 1)
        else:
            position = Position(batch.epoch + 1, 0)
        return make_state(position, self._order())

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Let the next `iter` begin where the state was taken, with any number of workers.

        Raises:
            OcnfError: code `state`; the first field that does not fit, with both values.
        """
        position = read_state(state, self._order())
        if position.step >= len(self):
            raise OcnfError("the state lies behind the end of the epoch", code="state",
                            where="the loader's state", field="step", found=position.step,
                            expected=f"0 to {len(self) - 1}")
        self._cursor.set(position, resumed=True)


def _of_worker(batches: Iterator[Batch]) -> Iterator[Batch]:
    with whole_from_worker():
        yield from batches


def place_in_world(rank: int | None, world_size: int | None, where: str = "ShardDataset") -> tuple[int, int]:
    """(rank, world size) as given, else of torch.distributed, else of the environment, else (0, 1)."""
    running = None
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        running = torch.distributed.get_rank(), torch.distributed.get_world_size()
    return place_among_ranks(rank, world_size, running, where)
