"""What generation passes around: items, the sample or the failure each becomes, and the stages in between.

These travel between processes and into JSON, so they hold plain values, and this module imports nothing
heavy: the driver and the workers, which only pass bytes on, stay small.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

from ocnf_data.errors import printable

EXCLUDED = "excluded"
"""The code of an input that is left out on purpose, and so is no failure."""


@dataclass(frozen=True)
class Item:
    """One input of the data set.

    Attributes:
        key: the sample's name, unique in the data set, [A-Za-z0-9_-]+.
        split: `train`, `val` or `test`.
        category: name of the category, as in the manifest.
        source: path of the mesh file relative to the meshes' root; `shapes:<category>:<split>:<index>` for a
            procedural shape; `sequence:<scan>:<index>` for a configuration of a scan.
        sha256: SHA-256 of the mesh file when the plan was made, or of what a scan's depth depends on; None
            for procedural shapes, and for a file that could not be read then (which becomes a failure row,
            not an aborted run).
        index: number of a procedural shape within its category and split, or of a configuration within its
            scan and split, from 0.
    """

    key: str
    split: str
    category: str
    source: str
    sha256: str | None = None
    index: int | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain values, as `plan.json` holds them."""
        return asdict(self)

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Item:
        """Inverse of `to_json`."""
        return cls(row["key"], row["split"], row["category"], row["source"], row["sha256"], row["index"])


@dataclass(frozen=True)
class ShardPlan:
    """One shard: `number` counts from 0 within its split."""

    split: str
    number: int
    items: tuple[Item, ...]

    @property
    def name(self) -> str:
        """`train-000007`."""
        return f"{self.split}-{self.number:06d}"


@dataclass(frozen=True)
class Failure:
    """Why an input gave no sample: a row of `failures.jsonl`.

    Attributes:
        item: its key; for an input that never became an item (an exclusion), its source.
        split, category, source: split, category and source of the item, as in `Item`.
        stage: where it stopped: `plan`, `start`, `read`, `normalise`, `render`, `fuse`, `encode`.
        code: `excluded`, `crash`, `timeout`, `out_of_memory`, `internal`, or the code of an OcnfError
            (`unreadable`, `empty`, `non_finite`, `degenerate`, `too_large`, `invisible`, ...).
        message: a sentence.
    """

    item: str
    split: str
    category: str
    source: str
    stage: str
    code: str
    message: str

    @classmethod
    def of(cls, item: Item, stage: str, code: str, message: str) -> Failure:
        """The failure of an item."""
        return cls(item.key, item.split, printable(item.category), printable(item.source), stage, code,
                   printable(message))

    def to_json(self) -> dict[str, Any]:
        """Plain values, as a row of `failures.jsonl`."""
        return asdict(self)

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> Failure:
        """Inverse of `to_json`."""
        return cls(**{name: row[name] for name in cls.__dataclass_fields__})


@dataclass(frozen=True)
class Sample:
    """One item's part of a shard, as bytes.

    Attributes:
        key: the item's.
        members: payload by member name (`json`, `target-64.oct`, ...), in the order they are written.
        timings: seconds by stage; recorded outside everything that is hashed.
    """

    key: str
    members: dict[str, bytes]
    timings: dict[str, float] = field(default_factory=dict)


class Stages:
    """Seconds spent by stage. `listener` hears of each stage as it begins.

    The listener is how the process that supervises knows where an item stood when it crashed or hung.
    """

    def __init__(self, listener: Callable[[str], None] | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.current = "start"
        self._listener = listener

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count the block's time under `name`; blocks of one name add up, and do not nest."""
        self.current = name
        if self._listener is not None and name not in self.seconds:
            self._listener(name)
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin
