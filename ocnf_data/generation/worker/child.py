"""The process that makes samples: `python -m ocnf_data.generation.worker.child <parent's pid>`.

It reads requests from its standard input and answers on its standard output (see `frames`), one item at a
time, so that a mesh which crashes a library or never ends costs this process and nothing else. What libraries
print goes to standard error. It is never forked: forking after OpenGL or a thread pool hangs.

It ends when its input closes, when its parent dies, and when it has had nothing to do for a while.
"""

from __future__ import annotations

import ctypes
import faulthandler
import importlib
import os
import signal
import sys
import time
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.generation.records import Item, Sample, Stages
from ocnf_data.generation.worker.memory import resident_bytes
from ocnf_data.generation.worker.pipe import read_frame, write_frame

IDLE_SECONDS = 120.0
IDLE_EXIT = 75  # os.EX_TEMPFAIL: ended because there was no work, not because of an item
_PR_SET_PDEATHSIG = 1


def run_child() -> int:
    """Serve until the input closes."""
    _die_with(int(sys.argv[1]))
    # Ctrl-C reaches the whole foreground group; what it means is for the driver to say.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    requests, replies = _private_pipes()
    setup, _ = read_frame(requests)
    make = _load(setup["maker"])(setup)
    write_frame(replies, {"kind": "ready", "resident": resident_bytes()})
    while True:
        try:
            request, _ = read_frame(requests, time.monotonic() + IDLE_SECONDS)
        except EOFError:
            return 0
        except TimeoutError:
            return IDLE_EXIT
        _answer(make, Item.from_json(request["item"]), replies)


def _answer(make: Any, item: Item, replies: int) -> None:
    stages = Stages(lambda name: write_frame(replies, {"kind": "stage", "stage": name}))
    try:
        sample: Sample = make(item, stages)
    except OcnfError as error:
        code, message = error.code, str(error)
    except MemoryError as error:
        code, message = "out_of_memory", f"not enough memory: {error}"
    except Exception as error:
        # A bug, or a library's surprise at one mesh in ten thousand: it costs that mesh a row that names it.
        code, message = "internal", f"{type(error).__name__}: {error} ({_place(error)})"
    else:
        header = {"kind": "sample", "key": sample.key, "names": list(sample.members),
                  "timings": {**sample.timings, **stages.seconds}, "resident": resident_bytes()}
        write_frame(replies, header, list(sample.members.values()))
        return
    write_frame(replies, {"kind": "failure", "stage": stages.current, "code": code, "message": message,
                          "resident": resident_bytes()})


def _load(path: str) -> Any:
    """The object at `package.module:name`."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def _place(error: BaseException) -> str:
    """File and line the exception was raised at."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "no traceback" if trace is None else f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}"


def _private_pipes() -> tuple[int, int]:
    """Take standard input and output for ourselves: whatever prints from now on prints to standard error."""
    requests, replies = os.dup(0), os.dup(1)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    os.dup2(2, 1)
    return requests, replies


def _die_with(parent: int) -> None:
    """Let the parent's death kill this process on Linux, even in mid-item; elsewhere its pipe ends it."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before we asked
        os._exit(1)


if __name__ == "__main__":
    sys.exit(run_child())
