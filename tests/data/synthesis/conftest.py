"""A manifest of small views, so that a sample costs milliseconds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numba
import pytest

from ocnf_data.manifest import Manifest

FIELDS: dict[str, Any] = {
    "name": "small",
    "seed": 3,
    "source": {"kind": "shapes", "categories": ["chair", "mug", "table"],
               "counts": {"train": 6, "val": 3, "test": 3}},
    "camera": {"rig": "fibonacci12", "width": 64, "height": 48, "fx": 35, "fy": 34, "cx": 31, "cy": 25},
    "resolutions": [16, 32],
    "inputs": [{"name": "v4", "views": 4, "sigma": 0.02,
                "encodings": ["histogram", "tsdf", "occupancy", "tdf_occupancy"]}],
    "shards": {"samples": 4},
}


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """On grids this small threads only wait for each other."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


@pytest.fixture(scope="session")
def small() -> Any:
    """The manifest; `synthesis` replaces that section's fields, other arguments whole fields."""

    def make(synthesis: dict[str, Any] | None = None, **changes: Any) -> Manifest:
        section = {"samples_per_epoch": 10, "views": [1, 3], "sigma": [0.0, 0.03], **(synthesis or {})}
        return Manifest.from_dict({**FIELDS, "synthesis": section, **changes})

    return make
