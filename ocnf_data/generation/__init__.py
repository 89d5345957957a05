"""Make a data set on disk from a manifest: planned, parallel, resumable, every input accounted for.

Names resolve on first use: a worker that imports `shard_task` needs no numpy, and stays small.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ocnf_data.generation.outcome import Report
    from ocnf_data.generation.run import Interrupted, generate

__all__ = ["Interrupted", "Report", "generate"]

_HOME = {"Interrupted": "run", "Report": "outcome", "generate": "run"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ocnf_data.generation' has no attribute {name!r}")
    return getattr(importlib.import_module(f"ocnf_data.generation.{_HOME[name]}"), name)
