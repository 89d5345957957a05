"""Stand-ins for `ocnf_data.generation.sample:maker`, for items whose sources say what is to happen.

A source's last part is the deed: `ok`, `raise`, `refuse`, `segfault`, `hang`, ..., with `-once` for only the
first time (a file in the folder `state` remembers).
"""

from __future__ import annotations

import ctypes
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.generation.records import Item, Sample, Stages

_ballast: list[bytearray] = []


def maker(setup: dict[str, Any]) -> Callable[[Item, Stages], Sample]:
    """Makes the same bytes from the same item, unless the item is made to misbehave."""
    state = Path(setup["meshes"]) if setup["meshes"] else None

    def make(item: Item, stages: Stages) -> Sample:
        deed = item.source.rpartition("/")[2]
        if deed.endswith("-once"):
            assert state is not None
            mark = state / f"{item.key}.done"
            deed = "ok" if mark.exists() else deed.removesuffix("-once")
            mark.touch()
        with stages("read"):
            print("libraries print what they like")
        with stages("render"):
            _do(deed)
        with stages("encode"):
            payload = item.key.encode() * 1000
            facts = {"key": item.key, "category": item.category, "source": item.source,
                     "leaf_counts": {"target-64.oct": 1, "v1-tsdf-64.oct": 1}}
            members = {"json": json.dumps(facts).encode(), "target-64.oct": payload,
                       "v1-tsdf-64.oct": payload[::-1]}
        return Sample(item.key, members, {"pid": float(os.getpid())})

    return make


def broken_maker(setup: dict[str, Any]) -> Callable[[Item, Stages], Sample]:
    """A maker that cannot even be set up."""
    raise RuntimeError("a library is broken")


def _do(deed: str) -> None:
    match deed:
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
