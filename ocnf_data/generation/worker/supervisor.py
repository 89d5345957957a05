"""Runs items in a child process that can be killed (promise 11).

An item that crashes its child or keeps it longer than the limit is tried once more, alone in a fresh child,
and then gives a `Failure` (`crash`, `timeout`). The child lives on from item to item: imports are paid once.

A pool of `pebble` in its place starts in 290 ms instead of 71, holds 25.5 MB in the supervising process
instead of 16, notices a child that ends with status 0 at the time limit only, and does not start inside
loky's workers (docs/decisions.md).
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from typing import IO, Any

from ocnf_data.errors import OcnfError
from ocnf_data.generation.records import Failure, Item, Sample
from ocnf_data.generation.worker.child import IDLE_EXIT
from ocnf_data.generation.worker.pipe import BrokenFrameError, read_frame, write_frame

DEFAULT_MAKER = "ocnf_data.generation.sample:maker"
# Faults of the machine, not of the item: every other item would fail too, so the run stops and says so.
FATAL_CODES = frozenset({"disk_full", "missing_extra"})
_PIPE_BYTES = 1 << 20
_START_TRIES = 2


@dataclass(frozen=True)
class ChildSetup:
    """What a child needs to know before its first item.

    Attributes:
        manifest: the resolved manifest, as plain values.
        meshes: the folder that `Item.source` is relative to; None for procedural shapes.
        views: URL of a folder of rendered views to use instead of rendering; None renders.
        keep_views: URL of the folder to keep rendered views in; None drops them.
        maker: import path of a function from this setup (as a dict) to `make(item, stages) -> Sample`.
    """

    manifest: dict[str, Any]
    meshes: str | None = None
    views: str | None = None
    keep_views: str | None = None
    maker: str = DEFAULT_MAKER


@dataclass(frozen=True)
class ChildLimits:
    """When to give up on a child.

    Attributes:
        item_seconds: seconds allowed for one item, compilation on a machine's very first run included.
        start_seconds: seconds allowed for starting the child and its imports.
        resident_bytes: a child that holds more than this after an item is replaced before the next.
    """

    item_seconds: float = 600.0
    start_seconds: float = 300.0
    resident_bytes: int = 700 * 2**20


class ChildDiedError(Exception):
    """The child is gone before it answered.

    Attributes:
        code: `crash` or `timeout`; `idle` where it had ended by itself because there was no work.
        stage: name of the stage that the item was in.
    """

    def __init__(self, code: str, stage: str, message: str) -> None:
        super().__init__(message)
        self.code = code
        self.stage = stage


class Supervisor:
    """Turns items into samples or failures, in a child process of its own. For one thread at a time."""

    def __init__(self, setup: ChildSetup, limits: ChildLimits) -> None:
        self.setup = setup
        self.limits = limits
        self.n_started = 0
        self._child: _Child | None = None

    def run(self, item: Item) -> Sample | Failure:
        """The item's sample, or why there is none.

        Raises:
            OcnfError: no child can be started, or the machine is at fault (`FATAL_CODES`).
        """
        deaths = 0
        while True:
            child = self._ready_child()
            try:
                result = child.make(item, self.limits.item_seconds)
            except ChildDiedError as death:
                self.close()
                deaths += death.code != "idle"
                if deaths > 1:
                    return Failure.of(item, death.stage, death.code, f"{death}, in a fresh process too")
                continue
            except BaseException:  # Ctrl-C: the child is in the middle of an item that nobody waits for
                self.close()
                raise
            if isinstance(result, Failure) and result.code in FATAL_CODES:
                raise OcnfError(result.message, code=result.code, where=item.source)
            return result

    def close(self) -> None:
        """End the child, if there is one."""
        if self._child is not None:
            self._child.kill()
            self._child = None

    def _ready_child(self) -> _Child:
        child = self._child
        if child is not None and (not child.alive or child.resident > self.limits.resident_bytes):
            self.close()
        if self._child is None:
            self._child = self._start()
        return self._child

    def _start(self) -> _Child:
        for left in reversed(range(_START_TRIES)):
            self.n_started += 1
            child = _Child(self.setup)
            try:
                child.wait_until_ready(self.limits.start_seconds)
            except ChildDiedError as death:
                child.kill()
                if not left:
                    raise OcnfError(f"the process that makes samples does not start: {death}", code="start",
                                    where=self.setup.maker, fix="run `ocnf-data doctor`") from death
            except BaseException:
                child.kill()
                raise
            else:
                return child
        raise AssertionError("unreachable")


class _Child:
    def __init__(self, setup: ChildSetup) -> None:
        self.resident = 0
        self._printed: IO[bytes] = tempfile.TemporaryFile("a+b")  # noqa: SIM115  closed in `kill`
        self._process = subprocess.Popen(
            # -P: a file in the user's working folder must not pass for a module of ours.
            [sys.executable, "-P", "-m", "ocnf_data.generation.worker.child", str(os.getpid())],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._printed,
            env=_environment(), bufsize=0, pipesize=_PIPE_BYTES)
        assert self._process.stdin is not None and self._process.stdout is not None
        self._requests = self._process.stdin.fileno()
        self._replies = self._process.stdout.fileno()
        self._setup = setup

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def wait_until_ready(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        self._send(asdict(self._setup))
        self._receive(deadline, "start", seconds)

    def make(self, item: Item, seconds: float) -> Sample | Failure:
        deadline = time.monotonic() + seconds
        os.ftruncate(self._printed.fileno(), 0)
        self._send({"item": item.to_json()})
        stage = "start"
        while True:
            header, payloads = self._receive(deadline, stage, seconds)
            match header["kind"]:
                case "stage":
                    stage = header["stage"]
                case "failure":
                    self.resident = header["resident"]
                    return Failure.of(item, header["stage"], header["code"], header["message"])
                case _:
                    self.resident = header["resident"]
                    members = dict(zip(header["names"], payloads, strict=True))
                    return Sample(header["key"], members, header["timings"])

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._printed):
            if pipe is not None:
                pipe.close()

    def _send(self, message: dict[str, Any]) -> None:
        try:
            write_frame(self._requests, message)
        except BrokenPipeError:
            raise self._death("start") from None

    def _receive(self, deadline: float, stage: str, seconds: float) -> tuple[dict[str, Any], list[bytes]]:
        try:
            return read_frame(self._replies, deadline)
        except TimeoutError:
            raise ChildDiedError("timeout", stage, f"not finished within {seconds:g} s") from None
        except (EOFError, BrokenFrameError, json.JSONDecodeError):
            raise self._death(stage) from None

    def _death(self, stage: str) -> ChildDiedError:
        try:
            status = self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            return ChildDiedError("crash", stage, "the process making it sent bytes that are no message")
        if status == IDLE_EXIT:
            return ChildDiedError("idle", stage, "the process ended because there was no work")
        how = signal.Signals(-status).name if status < 0 else f"exit status {status}"
        if status == -signal.SIGKILL:
            how += ", perhaps for lack of memory"
        printed = self._last_words()
        message = f"the process making it died ({how})" + (f": {printed}" if printed else "")
        return ChildDiedError("crash", stage, message)

    def _last_words(self, limit: int = 300) -> str:
        self._printed.seek(0)
        text = " | ".join(self._printed.read().decode(errors="replace").split("\n"))
        text = " ".join(text.split()).strip(" |")
        return text if len(text) <= limit else "..." + text[-limit:]


def _environment() -> dict[str, str]:
    """The parent's environment and import path, and one thread for everything: one worker is one core."""
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)  # noqa: PTH109
    one = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS",
                         "OPENCV_FOR_THREADS_NUM"), "1")
    # llvmpipe counts the threads beside the caller's.
    return {**os.environ, **one, "LP_NUM_THREADS": "0", "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}


_of_thread = threading.local()


def supervisor_of_this_thread(setup: ChildSetup, limits: ChildLimits) -> Supervisor:
    """The calling thread's supervisor, kept from shard to shard so that its child is too.

    One a thread, not one a process: a Dask worker may run several shards in threads of one process.
    """
    supervisor: Supervisor | None = getattr(_of_thread, "supervisor", None)
    if supervisor is None or (supervisor.setup, supervisor.limits) != (setup, limits):
        close_supervisor_of_this_thread()
        supervisor = _of_thread.supervisor = Supervisor(setup, limits)
    return supervisor


def close_supervisor_of_this_thread() -> None:
    """End the calling thread's child now instead of when it has been idle for a while."""
    supervisor: Supervisor | None = getattr(_of_thread, "supervisor", None)
    if supervisor is not None:
        supervisor.close()
        _of_thread.supervisor = None
