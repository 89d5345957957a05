"""Where the next iteration begins: (epoch, step), shared by the main process and all worker processes.

A `DataLoader` tells its data set nothing when an epoch begins: with `num_workers=0` it calls `iter` here,
with workers each of them calls `iter` on its own copy, in new processes every epoch or, persistent, in the
old ones. The copies have to agree on the epoch without a word from the main process. So there is one small
table in shared memory, under a lock. What identifies an iteration of a `DataLoader` is, from within,

    token       base seed of the workers, drawn by the DataLoader again each time it starts processes
    round       how many iterations this process has begun (persistent workers begin one each epoch)
    generation  how often `set` had been called when the process was made (tells iterations apart where the
                user seeds torch alike before each of them, so that tokens are equal)
    workers     how many share the iteration (a loader of four must not join what two began with equal tokens)

The first worker that comes with an identity takes the next epoch and writes it down; the others find it. A
worker that comes twice with the same identity is a new iteration too (equal tokens again). Iterations
that overlap (`zip(loader, loader)`) each get their own epoch.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from ocnf_data.arrays import I64
from ocnf_data.errors import OcnfError

MAX_WORKERS = 1024
_WORD = 63  # claim bits in an int64, sign left alone
_IDENTITY, _WHERE, _CLAIMS = slice(0, 4), slice(4, 6), slice(6, None)
_COLUMNS = 6 + -(-MAX_WORKERS // _WORD)
_ROWS = 32  # iterations remembered: those that run at the same time, and some
_PATIENCE = 60.0  # seconds; the lock is held for microseconds


class Identity(NamedTuple):
    """What the workers of one iteration have in common."""

    token: int
    round: int
    generation: int
    workers: int = 1


class Position(NamedTuple):
    """A batch: `step` is its number in the epoch, for this rank."""

    epoch: int
    step: int


class Cursor:
    """The next iteration's first batch. Travels to workers by fork or spawn; all copies share one memory."""

    def __init__(self) -> None:
        # A spawn context's lock and memory work under fork too; the other way round they do not.
        context = multiprocessing.get_context("spawn")
        self._lock = context.Lock()
        self._memory = context.RawArray("q", 4 + _ROWS * _COLUMNS)
        self.generation = 0
        """Calls of `set` that this process knows of."""

    def set(self, position: Position, resumed: bool = False) -> None:
        """Let the next iteration begin there; `resumed` marks a place that `set_epoch` of its epoch keeps."""
        self.generation += 1
        with self._locked() as (head, _):
            head[:] = [*position, resumed, head[3]]

    def peek(self) -> tuple[Position, bool]:
        """Where the next iteration begins, and whether a loaded state put it there."""
        with self._locked() as (head, _):
            return Position(int(head[0]), int(head[1])), bool(head[2])

    def claim(self, worker: int = 0, identity: Identity | None = None) -> Position:
        """Where an iteration that begins now starts.

        Args:
            worker: the worker's number.
            identity: identity of the iteration; None for one without workers.

        Raises:
            OcnfError: the worker's number is not below `MAX_WORKERS`, or the lock is held for a minute.
        """
        if not 0 <= worker < MAX_WORKERS:
            raise OcnfError("too many workers", where="DataLoader", field="num_workers",
                            expected=f"at most {MAX_WORKERS}")
        word, bit = worker // _WORD, 1 << (worker % _WORD)
        with self._locked() as (head, rows):
            newest = int(head[3])
            if identity is not None:
                for back in range(min(newest, _ROWS)):
                    row = rows[(newest - 1 - back) % _ROWS]
                    if tuple(row[_IDENTITY]) == identity and not row[_CLAIMS][word] & bit:
                        row[_CLAIMS][word] |= bit
                        return Position(*row[_WHERE].tolist())
            position = Position(int(head[0]), int(head[1]))
            head[:3] = [position.epoch + 1, 0, False]
            if identity is not None:
                row = rows[newest % _ROWS]
                row[:] = 0
                row[_IDENTITY], row[_WHERE] = identity, position
                row[_CLAIMS][word] = bit
                head[3] = newest + 1
            return position

    @contextmanager
    def _locked(self) -> Iterator[tuple[I64, I64]]:
        """((4,) next epoch, next step, resumed, iterations so far; (_ROWS, _COLUMNS) the iterations)."""
        if not self._lock.acquire(timeout=_PATIENCE):
            raise OcnfError("a worker died while it held the data set's lock", where="ShardDataset",
                            fix="make the ShardDataset again and load the last state")
        try:
            table = np.frombuffer(self._memory, np.int64)
            yield table[:4], table[4:].reshape(_ROWS, _COLUMNS)
        finally:
            self._lock.release()
