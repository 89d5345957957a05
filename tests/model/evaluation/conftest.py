"""A tiny data set, a small network without training, and a posed scan of a sphere and a box."""

from __future__ import annotations

import tarfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh

from ocnf_data import generate
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree, decode
from ocnf_data.render import render_depth
from ocnf_data.views.rigs import look_from
from ocnf_model import OctNetFusion

SIDES = (32, 64)
CENTRE = np.array([0.7, -1.2, 2.5])  # of the scanned sphere, metres
RADIUS = 0.2


def manifest(target: str = "tsdf") -> Manifest:
    """Two procedural shapes in the test split, one in the validation split."""
    return Manifest.from_dict({
        "schema": 1, "name": "tiny", "seed": 3, "target": target, "resolutions": list(SIDES),
        "source": {"kind": "shapes", "categories": ["chair", "mug"], "counts": {"test": 2, "val": 1}},
        "camera": {"rig": "published80", "width": 160, "height": 120, "fx": 88, "fy": 88, "cx": 80, "cy": 60,
                   "distance": 3.0},
        "inputs": [{"name": "v4", "views": 4, "sigma": 0.02, "encodings": ["tsdf", "histogram"]},
                   {"name": "v2", "views": 2, "sigma": 0.01, "encodings": ["histogram"]}],
        "shards": {"samples": 3},
    })


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The data set, with ground truth as TSDF."""
    out = tmp_path_factory.mktemp("tiny") / "set"
    generate(manifest(), out, jobs=1)
    return str(out)


@pytest.fixture(scope="session")
def members(tiny: str) -> Callable[[str, str], GridOctree]:
    """Octrees of the test split by (key, member), read without the loader."""
    found: dict[str, bytes] = {}
    for path in sorted(Path(tiny, "test").glob("*.tar")):
        with tarfile.open(path) as tar:
            found |= {entry.name: tar.extractfile(entry).read() for entry in tar}
    return lambda key, member: decode(found[f"{key}.{member}.oct"])


@pytest.fixture(scope="session")
def network() -> OctNetFusion:
    """Two levels with random weights, mostly free space."""
    torch.manual_seed(0)
    network = OctNetFusion(levels=2, channels=(2, 2, 2)).eval()
    for level in network.levels:
        level.head.bias.data.fill_(0.5)  # free space mostly, so that little is split
    return network.requires_grad_(False)


@pytest.fixture(scope="session")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """24 frames around a sphere, with a smaller box off its side; what is hit by nothing is not measured."""
    folder = tmp_path_factory.mktemp("scan")
    sphere = trimesh.creation.icosphere(5, RADIUS)
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.apply_translation([0.45, 0.05, 0.0])
    both = trimesh.util.concatenate([sphere, box])
    vertices = np.asarray(both.vertices) + CENTRE
    K = np.array([[500.0, 0, 159.5], [0, 500, 119.5], [0, 0, 1]])
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles), 0.9 * np.sin(3 * angles)], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    R, T = look_from(directions, 1.6)
    T = T - np.einsum("vij,j->vi", R, CENTRE)
    depth = render_depth(vertices, np.asarray(both.faces), K, R, T, size=(240, 320))
    np.savetxt(folder / "camera-intrinsics.txt", K)
    for i, image in enumerate(depth):
        millimetres = np.where(np.isfinite(image), np.rint(1000 * image), 0).astype(np.uint16)
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), millimetres)
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = R[i].T, -R[i].T @ T[i]
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", to_world)
    return folder
