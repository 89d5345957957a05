"""Where the network runs, and what to say when that has not enough memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from ocnf_data.errors import OcnfError


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
