"""Fixtures of the generation tests: small manifests, folders of meshes, and comparing data sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from ocnf_data.manifest import Manifest

# One octahedron, enough for every real stage.
OCTAHEDRON = """OFF
6 8 0
1 0 0
-1 0 0
0 1 0
0 -1 0
0 0 {height}
0 0 -1
3 0 2 4
3 2 1 4
3 1 3 4
3 3 0 4
3 2 0 5
3 1 2 5
3 3 1 5
3 0 3 5
"""

Meshes = Callable[..., Path]
Define = Callable[..., Manifest]


@pytest.fixture(autouse=True)
def _fake_makers_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Children inherit the import path, so `fake_makers:maker` resolves in them too."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of this process make fake samples."""
    monkeypatch.setattr("ocnf_data.generation.worker.supervisor.DEFAULT_MAKER", "fake_makers:maker")


@pytest.fixture(scope="session")
def write_meshes() -> Callable[[Path, Sequence[str]], None]:
    """Fill a folder with files of these names, each an octahedron of its own."""

    def write(folder: Path, names: Sequence[str]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        for i, name in enumerate(names):
            (folder / f"{name}.off").write_text(OCTAHEDRON.format(height=1 + i))

    return write


@pytest.fixture
def meshes(tmp_path: Path, write_meshes: Callable[[Path, Sequence[str]], None]) -> Meshes:
    """Make a folder `meshes` with files of these names in `chair/train`."""

    def make(names: Sequence[str], category: str = "chair", folder: str = "train") -> Path:
        write_meshes(tmp_path / "meshes" / category / folder, names)
        return tmp_path / "meshes"

    return make


@pytest.fixture(scope="session")
def define() -> Define:
    """A manifest of every mesh in `chair/train`, at 64^3 from 8 small views; arguments replace fields."""

    def make(**changes: Any) -> Manifest:
        return Manifest.from_dict({
            "name": "tiny",
            "source": {"kind": "modelnet", "categories": ["chair"], "counts": {"train": "all"}},
            "camera": {"rig": "fibonacci8", "width": 48, "height": 40, "fx": 28, "fy": 27, "cx": 24,
                       "cy": 20},
            "resolutions": [64],
            "inputs": [{"name": "v2", "views": 2, "sigma": 0.02, "encodings": ["tsdf"]}],
            "shards": {"samples": 4},
            **changes,
        })

    return make


@pytest.fixture(scope="session")
def contents() -> Callable[[Path], dict[str, bytes]]:
    """Every file of a data set but the timings, by name."""

    def read(folder: Path) -> dict[str, bytes]:
        return {path.relative_to(folder).as_posix(): path.read_bytes()
                for path in sorted(folder.rglob("*")) if path.is_file() and path.parent.name != "timings"}

    return read
