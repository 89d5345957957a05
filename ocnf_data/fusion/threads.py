"""Threads for kernels that release the GIL.

Tasks are taken from one queue, so that uneven ones balance, and each returns its own result: what comes out
does not depend on the number of threads. That number is numba's (`numba.set_num_threads`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")


def map_in_threads(function: Callable[[_Task], _Result], tasks: Iterable[_Task]) -> list[_Result]:
    """`[function(task) for task in tasks]` on numba's number of threads."""
    n_threads = numba.get_num_threads()
    if n_threads == 1:
        return [function(task) for task in tasks]
    with ThreadPoolExecutor(n_threads) as pool:
        return list(pool.map(function, tasks))
