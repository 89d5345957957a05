"""Kernels that run in threads, and in forked processes without them.

PyTorch forks its loader workers, and OpenMP does not survive a fork: where the main process has run a
parallel kernel, a worker that runs one is ended by numba.
"""

from __future__ import annotations

import functools
import os
import types
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from numba import njit

_P = ParamSpec("_P")
_R = TypeVar("_R")

_forked = False


def _note_fork() -> None:
    global _forked
    _forked = True


os.register_at_fork(after_in_child=_note_fork)


def in_threads(kernel: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a kernel over `prange` twice: parallel, and for processes that were forked serial.

    It can be called from Python alone. Each is compiled when it is first called, and cached.
    """
    parallel = njit(cache=True, nogil=True, parallel=True)(kernel)
    serial = njit(cache=True, nogil=True)(_copy(kernel))

    @functools.wraps(kernel)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        result: _R = (serial if _forked else parallel)(*args, **kwargs)
        return result

    return call


def _copy(kernel: Callable[_P, _R]) -> Callable[_P, _R]:
    """The same function by another name: numba's cache tells functions apart by name, not by options."""
    assert isinstance(kernel, types.FunctionType)
    copy = types.FunctionType(kernel.__code__, kernel.__globals__, f"{kernel.__name__}_serial")
    copy.__qualname__, copy.__module__ = f"{kernel.__qualname__}_serial", kernel.__module__
    copy.__annotations__, copy.__doc__ = kernel.__annotations__, kernel.__doc__
    return copy
