"""Ctrl-C and SIGTERM: one exception in the main thread, and none in the processes that it has started.

A command line calls `listen` first; from then on both signals raise `KeyboardInterrupt` once, wherever the
main thread is. Ctrl-C reaches every process of the terminal's foreground group, and a process that is stopped
while it starts prints a traceback, so whoever starts processes does that inside `starting_processes`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

Value = TypeVar("Value")

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SECONDS_OF_GRACE = 2.0
_SECONDS_UNTIL_AGAIN = 0.02


def _say_nothing(_: threading.ExceptHookArgs) -> None:
    """What becomes of a thread's traceback once all is to stop.

    Threads that watch other processes, loky's among them, are startled by their ends in more ways than one.
    """


def _look_away(number: int, frame: FrameType | None) -> None:
    """What becomes of the end of a child once all is to stop: batch systems stop every process of a job.

    PyTorch's handler, which makes an error of it, would raise that wherever the main thread is by then.
    """


class _Listener:
    """What has arrived, and whether it has to wait."""

    def __init__(self) -> None:
        self.process: int | None = None
        self.first: int | None = None
        self.since = 0.0
        self.delays = 0
        self.waiting = False
        self.lost = False
        self.hook_before = sys.unraisablehook
        self.of_children: Any = None

    def hear(self, number: int, _: FrameType | None) -> None:
        """The handler of both signals."""
        if os.getpid() != self.process:  # a forked process that has not set handlers of its own
            if number == signal.SIGTERM:
                os._exit(128 + number)
            return
        if self.lost:
            self.lost = False
        elif self.first is not None:  # a shell, a batch system may send both; one who insists gets their way
            if time.monotonic() - self.since > _SECONDS_OF_GRACE:
                os._exit(128 + number)
            return
        else:
            self.first, self.since = number, time.monotonic()
            threading.excepthook = _say_nothing
            self.of_children = signal.signal(signal.SIGCHLD, _look_away)
        if self.delays:
            self.waiting = True
        else:
            raise KeyboardInterrupt

    def hear_again(self, ignored: sys.UnraisableHookArgs) -> None:
        """Raise soon what Python ignored: it arrived in a `__del__`, or a callback of a weak reference."""
        if self.first is None or os.getpid() != self.process \
                or not isinstance(ignored.exc_value, KeyboardInterrupt):
            self.hook_before(ignored)
            return
        self.lost = True
        main = threading.main_thread().ident
        assert main is not None
        threading.Timer(_SECONDS_UNTIL_AGAIN, signal.pthread_kill, (main, self.first)).start()

    def catch_up(self) -> None:
        """Raise what had to wait."""
        if self.waiting and not self.delays:
            self.waiting = False
            raise KeyboardInterrupt


_listener = _Listener()


def listen() -> None:
    """Let SIGINT and SIGTERM raise `KeyboardInterrupt` in this process's main thread from now on."""
    if sys.unraisablehook == _listener.hear_again:  # again, where a process calls several commands
        sys.unraisablehook = _listener.hook_before
    if _listener.of_children is not None:
        signal.signal(signal.SIGCHLD, _listener.of_children)
    _listener.__init__()  # type: ignore[misc]
    _listener.process = os.getpid()
    sys.unraisablehook = _listener.hear_again
    for number in _SIGNALS:
        signal.signal(number, _listener.hear)


def is_interrupt(error: BaseException) -> bool:
    """Whether it is `KeyboardInterrupt`, or the SystemError that Python makes of one in compiled code.

    A signal that arrives while a function of numba's or PyTorch's hands its result over leaves both a result
    and an exception, which the interpreter reports as an error of its own, caused by the interrupt.
    """
    cause: BaseException | None = error
    while isinstance(cause, SystemError):  # each compiled function on the way adds one
        cause = cause.__cause__
    return isinstance(cause, KeyboardInterrupt)


def exit_status() -> int:
    """128 + the number of the signal that came first: 130 for Ctrl-C, 143 for SIGTERM."""
    return 128 + (_listener.first or signal.SIGINT)


@contextmanager
def starting_processes() -> Iterator[None]:
    """Let signals wait until the block has started its processes, which never get to see Ctrl-C.

    They inherit both signals blocked: `ignore_interrupts` in them opens SIGTERM again.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _listener.delays += 1
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        _listener.delays -= 1
        _listener.catch_up()


@contextmanager
def joblib_results(start: Callable[[], Generator[Value, None, None]]) -> Iterator[Iterator[Value]]:
    """What joblib's workers return, for as long as the block lasts; leaving it early kills the workers.

    Args:
        start: calls a `Parallel` with `return_as="generator_unordered"`, which starts its processes.
    """
    results = None
    try:
        with starting_processes(), _quiet_tracker():
            results = start()
        yield results
    finally:
        if results is not None:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message=".*have been cancelled")
                results.close()


@contextmanager
def _quiet_tracker() -> Iterator[None]:
    """Let the process that counts loky's semaphores, started inside, say nothing of what it finds at the end.

    It removes what a process that was stopped has left behind; whoever stopped it need not hear of that, and
    less of a semaphore that was removed just before its owner could say so.
    """
    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, [before, "ignore:resource_tracker:UserWarning"]))
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = before


def ignore_interrupts() -> None:
    """Let a worker process ignore Ctrl-C: the process that started it decides what is done then."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
