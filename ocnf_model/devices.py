"""Where the network runs, and what to say when that has not enough memory."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum

import torch

from ocnf_data.errors import OcnfError


class Precision(StrEnum):
    """What the convolutions compute in; weights, losses and Adam stay float32, and so does a TSDF's head."""

    FLOAT32 = "float32"
    """Single precision throughout."""
    BFLOAT16 = "bfloat16"
    """Autocast: half the memory of the activations."""


_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of malloc.h


def pick_device(name: str) -> torch.device:
    """The device of that name; `auto` is a GPU where there is one.

    Raises:
        OcnfError: no such device.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:  # torch built without CUDA asserts
        raise OcnfError("no such device here", field="device", found=name,
                        expected=f"auto or cpu ({str(error).splitlines()[0]})") from error
    return device


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, for its next tensors, where the C library is glibc.

    That gives large blocks back to the system at once and asks for them anew: a tenth of the processor time
    of a training step. The most that the process holds grows by a hundredth.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another library, another system
        return
    mallopt(_M_MMAP_MAX, 0)
    mallopt(_M_TRIM_THRESHOLD, -1)


def autocast(precision: Precision, device: torch.device) -> torch.autocast:
    """A context in which the operations of a network compute in that precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision is Precision.BFLOAT16)


def is_fast(precision: Precision, device: torch.device) -> bool:
    """Whether a device multiplies in that precision by itself; elsewhere bfloat16 is float32 made slow."""
    if precision is Precision.FLOAT32:
        return True
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


def wait_for(device: torch.device) -> None:
    """Wait until all that runs on a device is done, so that times can be measured."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@contextmanager
def memory_errors(where: str, fix: str) -> Iterator[None]:
    """Turn a lack of memory inside the block into an `OcnfError`, code `memory`, that says what to lower."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        text = str(error)
        # PyTorch's allocator for the CPU has no exception class: these are the texts of its errors.
        starved = isinstance(error, MemoryError | torch.OutOfMemoryError) or "can't allocate memory" in text \
            or "not enough memory" in text
        if not starved:
            raise
        raise OcnfError("out of memory", code="memory", where=where,
                        found=text.splitlines()[0] if text else None, fix=fix) from error
