"""Where the network runs, and what to say when that has not enough memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from ocnf_data.errors import OcnfError


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
