"""Stand-ins for `ocnf_data.generation.sample:maker`, for items whose file names say what is to happen.

`chair/train/segfault_3.off` crashes, `ok_1.off` makes a sample; `-once` misbehaves the first time only,
`-unfixed` as long as there is no file `.fixed` in the folder of the meshes.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.generation.records import Item, Sample, Stages
from ocnf_data.generation.worker.memory import resident_bytes

_ballast: list[bytearray] = []


def maker(setup: dict[str, Any]) -> Callable[[Item, Stages], Sample]:
    """Makes the same bytes from the same item, unless the item is made to misbehave."""
    root = Path(setup["meshes"] or ".")

    def make(item: Item, stages: Stages) -> Sample:
        with stages("read"):
            print("libraries print what they like")
            deed = _deed(item, root)
        with stages("render"):
            _do(deed)
        with stages("encode"):
            payload = item.key.encode() * 3000
            facts = {"key": item.key, "category": item.category, "source": item.source,
                     "leaf_counts": {"target-64.oct": 1, "v1-tsdf-64.oct": 1}}
            members = {"json": json.dumps(facts).encode(), "target-64.oct": payload,
                       "v1-tsdf-64.oct": payload[::-1]}
        return Sample(item.key, members, {"pid": float(os.getpid())})

    return make


def measured_maker(setup: dict[str, Any]) -> Callable[[Item, Stages], Sample]:
    """The real maker; the memory that the process holds after each item stands among its timings."""
    from ocnf_data.generation.sample import maker as real_maker

    real = real_maker(setup)

    def make(item: Item, stages: Stages) -> Sample:
        sample = real(item, stages)
        gc.collect()
        return Sample(sample.key, sample.members, {"pid": float(os.getpid()), "resident": resident_bytes()})

    return make


def leaking_maker(setup: dict[str, Any]) -> Callable[[Item, Stages], Sample]:
    """The same, except that it keeps half a megabyte of each item."""
    measured = measured_maker(setup)

    def make(item: Item, stages: Stages) -> Sample:
        _ballast.append(bytearray(os.urandom(1) * 2**19))
        return measured(item, stages)

    return make


def broken_maker(setup: dict[str, Any]) -> Callable[[Item, Stages], Sample]:
    """A maker that cannot even be set up."""
    raise RuntimeError("a library is broken")


def _deed(item: Item, root: Path) -> str:
    deed, _, when = PurePosixPath(item.source).stem.partition("_")[0].partition("-")
    if when == "unfixed":
        return "ok" if (root / ".fixed").exists() else deed
    if when == "once":
        mark = root / f".{item.key}.done"
        if mark.exists():
            return "ok"
        mark.touch()
    return deed


def _do(deed: str) -> None:
    match deed:
        case "slow":
            time.sleep(0.05)
        case "raise":
            raise ZeroDivisionError("of all things")
        case "refuse":
            raise OcnfError("the mesh has no faces", code="empty", where="a.off")
        case "full":
            raise OcnfError("the disk is full", code="disk_full")
        case "segfault":
            ctypes.string_at(0)
        case "exit":
            os._exit(0)
        case "hang":
            time.sleep(1000)
        case "deaf":  # hangs where no Python signal handler runs
            ctypes.CDLL(None).sleep(1000)
        case "hoard":
            _ballast.append(bytearray(os.urandom(1) * (200 * 2**20)))
        case "orphan":  # as the out-of-memory killer may, take the worker and not the child
            os.kill(os.getppid(), signal.SIGKILL)
            time.sleep(1000)
