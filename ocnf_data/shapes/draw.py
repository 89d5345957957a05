"""Random choices that are a pure function of a key, the same with every version of numpy."""

from __future__ import annotations

import hashlib
from typing import TypeVar

import numpy as np

_T = TypeVar("_T")


class Draw:
    """A stream of choices, keyed by the SHA-256 of the parts of a key.

    Only raw doubles of Philox are drawn, never a distribution of numpy's, whose streams may change.
    """

    def __init__(self, *key: object) -> None:
        digest = hashlib.sha256("\0".join(map(str, key)).encode()).digest()
        self._random = np.random.Generator(np.random.Philox(key=int.from_bytes(digest[:16], "little"))).random

    def between(self, low: float, high: float) -> float:
        """A number in [low, high)."""
        return low + (high - low) * float(self._random())

    def count(self, low: int, high: int) -> int:
        """A whole number from low to high, both included."""
        return low + int((high - low + 1) * self._random())

    def chance(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self._random() < probability)

    def pick(self, *options: _T) -> _T:
        """One of the options, each as likely."""
        return options[int(len(options) * self._random())]

    def flags(self, n: int, probability: float) -> np.ndarray:
        """(n,) bool, each True with the given probability."""
        return self._random(n) < probability
