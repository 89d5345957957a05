"""Where the network runs, and what to say when that has not enough memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from ocnf_data.errors import OcnfError


def pick_device(name: str) -> torch.device:
    """The device of a name as torch knows it; `auto` is a GPU where there is one.

    Raises:
        OcnfError: no such device here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:  # torch asserts that it was built with CUDA
        raise OcnfError("no such device on this machine", field="device", found=name,
                        expected="auto, cpu, or cuda where there is a GPU") from error
    return device


def wait_for(device: torch.device) -> None:
    """Let all that runs on a device come to an end, so that a clock means something."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@contextmanager
def memory_errors(what: str, fix: str) -> Iterator[None]:
    """Turn a lack of memory inside the block into an `OcnfError` that says what to lower."""
    try:
        yield
    except (torch.OutOfMemoryError, MemoryError) as error:
        raise OcnfError(f"not enough memory for {what}", code="memory", fix=fix) from error
    except RuntimeError as error:
        if "not enough memory" not in str(error):  # so the CPU's allocator says
            raise
        raise OcnfError(f"not enough memory for {what}", code="memory", fix=fix) from error
