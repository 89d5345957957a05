"""Chance that is a pure function of a key, the same in every process and order of work."""

from __future__ import annotations

import hashlib
import json

import numpy as np


def keyed_random(*key: str | int) -> np.random.Generator:
    """Philox4x64 keyed by 128 bits of the SHA-256 of the parts of a key, as a list in JSON."""
    digest = hashlib.sha256(json.dumps(key).encode()).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest[:16], "little")))
