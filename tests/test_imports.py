"""What importing costs: no network library, no OpenGL, no mesh library where none is needed."""

from __future__ import annotations

import subprocess
import sys

import pytest

import ocnf_data

HEAVY = ("torch", "trimesh", "pyrender", "OpenGL", "h5py", "joblib", "cv2", "matplotlib", "skimage",
         "webdataset", "dask", "distributed", "ray")


def loaded(statement: str, names: tuple[str, ...]) -> list[str]:
    """Which of the modules a fresh interpreter has after a statement."""
    code = f"import sys; {statement}; print(*[name for name in {names!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return result.stdout.split()


@pytest.mark.parametrize("statement", [
    "import ocnf_data",
    "import ocnf_data.octree, ocnf_data.fusion, ocnf_data.render, ocnf_data.views.noise",
    "import ocnf_data.manifest, ocnf_data.files.storage, ocnf_data.shards, ocnf_data.views.store",
    "from ocnf_data import GridOctree, Views, render_depth, fuse_tsdf, generate, load_manifest, OcnfError",
    "import ocnf_data.generation.sample",
    "import ocnf_data.cli",
])
def test_extras_are_loaded_only_when_used(statement: str) -> None:
    assert loaded(statement, HEAVY) == []


def test_the_package_and_its_command_line_start_light() -> None:
    assert loaded("import ocnf_data, ocnf_data.cli", ("numpy", "numba", "pydantic", "fsspec", "yaml")) == []


def test_every_public_name_resolves() -> None:
    assert all(getattr(ocnf_data, name) is not None for name in ocnf_data.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        ocnf_data.nonsense  # noqa: B018


@pytest.mark.parametrize("module", ["ocnf_data.generation.run", "ocnf_model.training.run"])
def test_locks_need_nothing_that_only_unix_has(module: str) -> None:
    assert loaded(f"sys.modules['fcntl'] = None; import {module}", ("fcntl", module)) == ["fcntl", module]


@pytest.mark.parametrize("statement", ["import ocnf_model", "import ocnf_model.network, ocnf_model.ops",
                                       "import ocnf_model.cli"])
def test_the_network_needs_no_mesh_library_and_no_opengl(statement: str) -> None:
    assert loaded(statement, ("trimesh", "pyrender", "OpenGL", "skimage")) == []
