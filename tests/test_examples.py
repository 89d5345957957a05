"""Every example runs, on a tiny data set, and does what it says."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ocnf_data.generation import generate
from ocnf_data.manifest import Manifest
from ocnf_data.meshes import read_mesh
from ocnf_data.meshes.topology import is_watertight
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.shapes import make_shape
from ocnf_data.shards.browse import find_sample

ROOT = Path(__file__).parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SMALL_CAMERA = {"rig": "fibonacci8", "width": 64, "height": 48, "fx": 35, "fy": 35, "cx": 32, "cy": 24}


def example(name: str) -> ModuleType:
    """The example as a module; its `main` takes a list of arguments."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", ROOT / f"examples/{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Four shapes at 32^3."""
    folder = tmp_path_factory.mktemp("examples") / "OUT"
    generate(Manifest.from_dict({
        "name": "small", "source": {"kind": "shapes", "categories": ["sofa", "mug"], "counts": {"train": 4}},
        "camera": SMALL_CAMERA, "resolutions": [32],
        "inputs": [{"name": "v4", "views": 4, "sigma": 0.02, "encodings": ["histogram", "tsdf"]}],
    }), folder, progress=False)
    return str(folder)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_says_how_it_is_called(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60
    assert f"    python examples/{path.name} " in text.split('"""')[1]
    assert path.name in (ROOT / "docs/examples.md").read_text(encoding="utf-8")
    assert f"example(\"{path.stem}\")" in Path(__file__).read_text(encoding="utf-8")


def test_a_dense_network_learns(data: str) -> None:
    losses = example("train_dense_cnn").main([data, "--resolution", "32", "--epochs", "8", "--width", "4",
                                              "--workers", "0"])
    assert len(losses) == 8
    assert losses[-1] < 0.8 * losses[0]


def test_meshes_become_a_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = example("own_meshes")
    meshes = []
    for index, suffix in enumerate((".ply", ".obj", ".off")):
        shape = make_shape("mug", 0, index, "train")
        meshes.append(tmp_path / f"mesh_{index}{suffix}")
        meshes[-1].write_bytes(WRITERS[suffix](shape.vertices, shape.faces))
    of_dict = Manifest.from_dict
    monkeypatch.setattr(module.Manifest, "from_dict",  # the paper's 80 views of 640x480 take their time
                        lambda fields: of_dict({**fields, "camera": SMALL_CAMERA}))
    report = module.main([str(tmp_path / "OUT"), *map(str, meshes), "--resolutions", "32", "--jobs", "1"])
    assert (report.items, report.samples, report.failures) == (3, 3, ())
    splits = json.loads((tmp_path / "OUT/dataset.json").read_text())["splits"]
    assert {split: sum(shard["samples"] for shard in shards) for split, shards in splits.items()} == {
        "train": 2, "test": 1}


def test_arrays_become_a_mesh(tmp_path: Path) -> None:
    """A ball of 1 m around the origin, within a voxel of 47 mm; without warnings about poses."""
    vertices = example("fuse_arrays").main([str(tmp_path / "ball.ply"), "--resolution", "64"])
    off = np.abs(np.linalg.norm(vertices, axis=1) - 1)
    assert off.max() < 3 / 64 and off.mean() < 0.01
    mesh = read_mesh(tmp_path / "ball.ply")
    assert is_watertight(mesh.faces) and len(mesh.vertices) == len(vertices)


def test_an_encoding_of_ones_own(data: str, tmp_path: Path) -> None:
    module = example("own_encoding")
    module.main([data, str(tmp_path / "encoded")])
    files = sorted((tmp_path / "encoded").glob("*.npz"))
    assert len(files) == 4
    with np.load(files[0]) as file:
        inputs, target = file["inputs"], file["target"]
    assert inputs.shape == (3, 32, 32, 32) and target.shape == (1, 32, 32, 32)
    total = inputs.sum(axis=0)
    np.testing.assert_allclose(total[total > 0], 1, atol=1e-6)
    past, near, blocked = inputs
    # The TSDF of the same views says the same of a voxel that they agree on; pixels at .5 may go either way.
    tsdf = find_sample(data, files[0].stem).octree("v4-tsdf-32.oct").to_dense()[0]
    free, hidden = (past > 0) & (near == 0), blocked == 1
    assert free.sum() > 1000 and hidden.sum() > 300
    assert (tsdf[free] == 1).mean() > 0.999 and (tsdf[hidden] == -1).mean() > 0.999
    assert (np.abs(tsdf[near > 0]) < 1).mean() > 0.9


def test_points_are_exported_and_read(data: str, tmp_path: Path) -> None:
    assert example("export_points").main([data, str(tmp_path / "points"), "--points", "300"]) == 4


def test_an_example_runs_as_a_program(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, str(ROOT / "examples/own_meshes.py"), "--help"], cwd=tmp_path,
                          capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "own_meshes.py OUT chair.obj" in done.stdout
