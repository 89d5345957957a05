"""A folder of procedural meshes laid out as ModelNet, and one table made from it by a tiny budget."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import trimesh
from rich.console import Console

from ocnf_data.shapes import make_shape
from ocnf_model.tables.plan import TablePlan
from ocnf_model.tables.run import make_tables
from ocnf_model.training.settings import TrainSettings, read_settings

CATEGORIES = ("airplane", "chair", "table")
TINY: dict[str, Any] = {"channels": [2, 2, 2], "levels": 1, "workers": 0, "stages": [
    {"epochs": 1, "batch_size": 2, "accumulate": 1, "learning_rate": 1e-2}]}


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three categories, three meshes to train on and two to test on each."""
    folder = tmp_path_factory.mktemp("meshes")
    for category in CATEGORIES:
        for split, n in (("train", 3), ("test", 2)):
            (folder / category / split).mkdir(parents=True)
            for index in range(n):
                shape = make_shape(category, 0, index, split)
                mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
                mesh.export(folder / category / split / f"{category}_{index:04d}.off")
    return folder


@pytest.fixture(scope="session")
def settings() -> TrainSettings:
    """A network of two channels, one level."""
    return read_settings(TINY, "the test")


@pytest.fixture(scope="session")
def make(root: Path, settings: TrainSettings) -> Callable[..., TablePlan]:
    """`make_tables` with the tiny budget: `make(name, out, **changes)`."""
    def make_one(name: str, out: Path, **changes: Any) -> TablePlan:
        budget: dict[str, Any] = {"meshes": 6, "test": 2, "settings": settings, "resolutions": [32],
                                  "epochs": [1], "weight_models": 1, "device": "cpu",
                                  "console": Console(quiet=True)}
        if name not in ("kinect", "completion"):
            budget["stand_ins"] = {"desk": "table"}
        return make_tables(name, root, out, **{**budget, **changes})

    return make_one


@pytest.fixture(scope="session")
def planned(make: Callable[..., TablePlan], tmp_path_factory: pytest.TempPathFactory
            ) -> tuple[Path, TablePlan]:
    """A folder in which the table runtime was planned, and the plan."""
    out = tmp_path_factory.mktemp("planned") / "out"
    return out, make("runtime", out, dry_run=True)


@pytest.fixture(scope="session")
def made(make: Callable[..., TablePlan], tmp_path_factory: pytest.TempPathFactory
         ) -> tuple[Path, dict[str, TablePlan]]:
    """A folder with the tables encodings and then unseen, and the plans that were gone through."""
    out = tmp_path_factory.mktemp("tables") / "out"
    return out, {name: make(name, out) for name in ("encodings", "unseen")}
