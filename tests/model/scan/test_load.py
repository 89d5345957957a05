"""The way into the network from Python: load, fuse, look at what came out."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ocnf_data
import ocnf_model
from ocnf_data import OcnfError, Scan, octree_surface, read_scan
from ocnf_model import TrainedNetwork, load_network

CENTRE, RADIUS = np.array([0.7, -1.2, 2.5]), 0.2  # as in conftest.py
BOX = (*(CENTRE - 0.23), *(CENTRE + 0.23))


@pytest.fixture(scope="module")
def pretrained() -> TrainedNetwork:
    return load_network("pretrained", device="cpu")


def test_a_sphere_comes_back_with_its_octrees(scan: Path, pretrained: TrainedNetwork, tmp_path: Path) -> None:
    result = pretrained.fuse(read_scan(scan, every=3), box=BOX, resolution=128)
    assert list(result.octrees) == [64, 128] and result.resolution == 128
    for resolution, octree in result.octrees.items():
        # The sign at voxel centres is the sphere's, but for the voxels that the surface passes through.
        voxel = result.region.size / resolution
        z, y, x = np.mgrid[:resolution, :resolution, :resolution] * voxel + (voxel - result.region.size) / 2
        distance = np.linalg.norm(np.stack([x, y, z], -1) + result.region.centre - CENTRE, axis=-1) - RADIUS
        near = (distance > 1.5 * voxel) & (distance < 3 * voxel) | (distance < -1.5 * voxel)
        assert ((octree.to_dense()[0] < 0) == (distance < 0))[near].mean() > 0.97
    off = np.abs(np.linalg.norm(result.vertices - CENTRE, axis=1) - RADIUS)
    assert np.median(off) < result.region.size / 128 and result.faces.max() < len(result.vertices)
    whole, _ = octree_surface(result.octree, result.region.size, centre=result.region.centre)
    assert {tuple(v) for v in result.vertices} <= {tuple(v) for v in whole}
    result.save(tmp_path / "mesh.obj")
    assert (tmp_path / "mesh.obj").read_text().count("\nf ") >= len(result.faces) - 1
    with pytest.raises(OcnfError, match="cannot be written"):
        result.save(tmp_path / "mesh.png")


def test_bare_views_are_a_scan_too(scan: Path, pretrained: TrainedNetwork) -> None:
    read = read_scan(scan, every=6)
    from_views = pretrained.fuse(read.views, box=BOX, resolution=64)
    from_scan = pretrained.fuse(Scan(read.views, read.names), box=BOX, resolution=64)
    np.testing.assert_array_equal(from_views.vertices, from_scan.vertices)
    np.testing.assert_array_equal(from_views.faces, from_scan.faces)


def test_what_the_command_line_takes_python_does(scan: Path, pretrained: TrainedNetwork,
                                                 tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    found = pretrained.fuse(read_scan(scan, every=3), box=BOX, voxel=0.0105, resolution=64, faces=1000,
                            max_depth=3.0, report=lambda *done: told.append(done))
    assert told == [(1, 1)] and found.voxel == pytest.approx(0.0105) and 500 < len(found.faces) <= 1000
    off = np.abs(np.linalg.norm(found.vertices - CENTRE, axis=1) - RADIUS)
    assert np.median(off) < 0.0105
    found.save(tmp_path / "mesh.glb")
    with pytest.raises(OcnfError, match="cannot both be fused"):
        pretrained.fuse(read_scan(scan, every=12), box=BOX, room=True)


def test_it_says_what_it_was_trained_on(pretrained: TrainedNetwork) -> None:
    assert pretrained.resolutions == [64, 128, 256]
    assert [header.level for header in pretrained.headers] == [1, 2, 3]
    assert not any(weight.requires_grad for weight in pretrained.module.parameters())


@pytest.mark.parametrize(("change", "message"), [
    ({"scan": "folder"}, "not depth frames"),
    ({"resolution": 100}, "no level of this resolution"),
    ({"box": (0, 0, 0, 1)}, "not a box"),
    ({"box": "here"}, "box: not one array of numbers"),
    ({"box": 1.0}, "not a box"),
    ({"room": "no"}, "room: neither true nor false; found no"),
    ({"faces": 100.5}, "not a number of faces"),
    ({"box": (50, 50, 50, 51, 51, 51)}, "no frame looks at it"),
])
def test_what_cannot_be_fused_is_refused(scan: Path, pretrained: TrainedNetwork, change: dict,
                                         message: str) -> None:
    asked = {"scan": read_scan(scan, every=12), "box": BOX, "resolution": 64, **change}
    with pytest.raises(OcnfError, match=message):
        pretrained.fuse(asked.pop("scan"), **asked)


def test_no_such_run() -> None:
    with pytest.raises(OcnfError, match="no such run"):
        load_network("nothing-here")


def test_neither_training_nor_opengl_nor_a_compiler_is_loaded() -> None:
    code = ("import sys; from ocnf_data import read_scan, octree_surface, Scan; from ocnf_model import "
            "load_network, Reconstruction; load_network('pretrained', device='cpu'); "
            "names = ['ocnf_model.training', 'ocnf_data.generation', 'trimesh', 'pyrender', 'OpenGL', "
            "'tensorboard', 'matplotlib', 'torch._dynamo', 'sympy']; "
            "print([name for name in names if name in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_of_the_network_resolves() -> None:
    assert all(getattr(ocnf_model, name) is not None for name in ocnf_model.__all__)
    assert all(getattr(ocnf_data, name) is not None for name in ("Scan", "read_scan", "octree_surface"))
