"""What `pip install` brings: the wheel, installed beside nothing of the repository, in an empty folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
SHIPPED = sorted(path.name for path in (ROOT / "manifests").glob("*.yaml"))


# Six views of a box of 1 m without noise, fused by the shipped network: is it closed, and how large is it?
FUSE = """
import numpy as np, trimesh
import ocnf_model
from ocnf_data import Views, render_depth
from ocnf_data.views.rigs import fibonacci, look_from
from ocnf_model import load_network
box = trimesh.creation.box((1.0, 1.0, 1.0))
K = np.array([[100.0, 0, 79.5], [0, 100, 59.5], [0, 0, 1]])
R, T = look_from(fibonacci(6), 2.5)
depth = render_depth(np.asarray(box.vertices), np.asarray(box.faces), K, R, T, size=(120, 160))
network = load_network("pretrained", device="cpu")
mesh = network.fuse(Views(depth, K, R, T), box=[-0.8] * 3 + [0.8] * 3, resolution=64, keep_unseen=True)
found = trimesh.Trimesh(mesh.vertices, mesh.faces)
print(ocnf_model.__file__, found.is_watertight, round(abs(found.volume), 4))
"""


def pip(*arguments: object) -> None:
    offline = ("--quiet", "--no-deps", "--no-index", "--disable-pip-version-check")
    done = subprocess.run([sys.executable, "-m", "pip", *map(str, arguments), *offline], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built offline from a copy, so that the repository gets no folder `build`."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in ("ocnf_data", "ocnf_model", "manifests"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, source)
    pip("wheel", source, "--no-build-isolation", "--wheel-dir", folder / "dist")
    [built] = (folder / "dist").glob("*.whl")
    return built


def test_the_wheel_has_the_manifests_and_the_weights(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
    assert names >= {f"ocnf_data/manifests/{name}" for name in SHIPPED} and len(SHIPPED) > 5
    assert names >= {f"ocnf_model/pretrained/level-{level}.safetensors" for level in (1, 2, 3)}
    assets = {path.relative_to(ROOT).as_posix() for path in (ROOT / "ocnf_data/report/assets").iterdir()}
    assert assets <= names and {"ocnf_data/report/assets/three.min.js",
                                "ocnf_data/report/assets/three-LICENSE.txt"} <= assets
    modules = {path.relative_to(ROOT).as_posix() for package in ("ocnf_data", "ocnf_model")
               for path in (ROOT / package).rglob("*.py")}
    assert modules <= names
    assert {name.split("/")[0].split("-")[0] for name in names} == {"ocnf_data", "ocnf_model", "ocnf"}


@pytest.mark.slow
def test_a_newcomers_first_commands(wheel: Path, tmp_path: Path) -> None:
    """In an empty folder, with the installed scripts, and without the repository on the path."""
    site, work = tmp_path / "site", tmp_path / "work"
    pip("install", "--target", site, wheel)
    work.mkdir()
    env = {**os.environ, "PYTHONPATH": str(site), "COLUMNS": "200",
           "NUMBA_CACHE_DIR": str(tmp_path / "numba")}

    def run(*command: object, status: int = 0) -> str:
        program, *arguments = map(str, command)
        done = subprocess.run([site / "bin" / program, *arguments], cwd=work, env=env, capture_output=True,
                              text=True, check=False)
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr

    listed = run("ocnf-data", "manifests")
    assert all(f" {name.removesuffix('.yaml')} " in listed for name in SHIPPED)
    assert "ocnf-data generate demo.yaml --out OUT" in run("ocnf-data", "init", "demo")
    assert (work / "demo.yaml").read_bytes() == (ROOT / "manifests/demo.yaml").read_bytes()
    assert "is there already" in run("ocnf-data", "init", "demo", status=1)
    assert "meshes" in run("ocnf-data", "init", "mesh", status=1)
    manifest = yaml.safe_load((work / "demo.yaml").read_text())  # smaller, as a newcomer might edit it
    manifest["source"] |= {"categories": ["mug"], "counts": {"train": 2}}
    manifest["camera"] |= {"rig": "icosphere0", "width": 96, "height": 72, "fx": 52, "fy": 52, "cx": 48,
                           "cy": 36}
    manifest["resolutions"] = [64]
    (work / "demo.yaml").write_text(yaml.safe_dump(manifest))
    run("ocnf-data", "generate", "demo.yaml", "--out", "OUT", "--jobs", "1")
    assert "whole" in run("ocnf-data", "verify", "OUT", "--jobs", "1")
    run("ocnf-data", "show", "OUT", "--key", "0001", "--out", "mug.png")
    assert (work / "mug.png").read_bytes().startswith(b"\x89PNG")
    done = subprocess.run([sys.executable, "-c", FUSE], cwd=work, env=env, capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stderr
    place, closed, inside = done.stdout.split()
    assert place.startswith(str(site)) and closed == "True" and 0.9 < float(inside) < 1.1
