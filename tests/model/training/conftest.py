"""One tiny data set for all tests of training: procedural shapes, small views, 32^3 and 64^3."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import pytest
import torch

from ocnf_data import generate
from ocnf_data.manifest import Manifest
from ocnf_model.training.settings import TrainSettings, read_settings

MANIFEST = {
    "name": "tiny",
    "source": {"kind": "shapes", "categories": ["chair", "lamp"], "counts": {"train": 5, "val": 2}},
    "camera": {"rig": "fibonacci8", "width": 48, "height": 40, "fx": 28, "fy": 27, "cx": 24, "cy": 20},
    "resolutions": [32, 64],
    "inputs": [{"name": "v2", "views": 2, "sigma": 0.01, "encodings": ["tsdf", "tdf_occupancy"]}],
    "shards": {"samples": 4},
}


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> Iterator[None]:
    """On grids this small threads only wait for each other, above all beside other processes."""
    before = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    yield
    torch.set_num_threads(before[0])
    numba.set_num_threads(before[1])


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Five training samples and two to validate; inputs `v2` in two encodings, no histograms."""
    folder = tmp_path_factory.mktemp("tiny") / "set"
    report = generate(Manifest.from_dict(MANIFEST), str(folder))
    assert report.ok
    return str(folder)


@pytest.fixture(scope="session")
def small() -> Any:
    """Settings of a tiny network; arguments replace fields."""

    def make(**changes: Any) -> TrainSettings:
        stage = {"epochs": 1, "batch_size": 2, "accumulate": 2, "learning_rate": 1e-3}
        fields = {"levels": 2, "encoding": "tsdf", "channels": [2, 3, 4], "stages": [stage], "workers": 0}
        return read_settings({**fields, **changes}, "test")

    return make


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder for a run."""
    return tmp_path / "run"
