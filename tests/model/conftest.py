"""Random batches and the dense definition; a tiny data set, an untrained network, a scan of two solids."""

from __future__ import annotations

import itertools
import tarfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import strategies as st

from ocnf_data import generate
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree, decode
from ocnf_data.render import render_depth
from ocnf_data.views.rigs import look_from
from ocnf_model import OctNetFusion
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.structure import Structure

RESOLUTIONS = (32, 64)
CENTRE = np.array([0.7, -1.2, 2.5])  # of the scanned sphere, metres
RADIUS = 0.2


def random_trees(rng: np.random.Generator, n: int, likelihood: float) -> np.ndarray:
    """(n, 2) uint64: every node is split with that likelihood, if its parent is."""
    split = np.zeros((n, 73), bool)
    split[:, 0] = rng.random(n) < likelihood
    for i in range(1, 73):
        split[:, i] = split[:, (i - 1) // 8] & (rng.random(n) < likelihood)
    bits = np.zeros((n, 128), np.uint64)
    bits[:, :73] = split
    weights = np.uint64(1) << np.arange(64, dtype=np.uint64)
    return (bits.reshape(n, 2, 64) * weights).sum(axis=2, dtype=np.uint64)


def random_batch(seed: int, grid: tuple[int, int, int] = (1, 1, 1), batch_size: int = 1, channels: int = 2,
                 likelihood: float = 0.5, dtype: torch.dtype = torch.float64) -> OctreeBatch:
    """A batch with random trees and standard normal features."""
    rng = np.random.default_rng(seed)
    trees = random_trees(rng, batch_size * int(np.prod(grid)), likelihood)
    structure = Structure(trees.reshape(batch_size, *grid, 2))
    features = torch.from_numpy(rng.standard_normal((structure.n_leaves, channels)))
    return OctreeBatch(structure, features.to(dtype))


@st.composite
def random_batches(draw: st.DrawFn, channels: int | None = None, even: bool = False) -> OctreeBatch:
    """Batches of 1-3 grids of different structures, non-cubic grids, all-leaf and all-voxel trees likely."""
    sides = st.sampled_from([2, 2, 4]) if even else st.integers(1, 3)
    grid = draw(st.tuples(sides, sides, sides).filter(lambda sides: np.prod(sides) <= 16))
    channels = draw(st.integers(1, 3)) if channels is None else channels
    return random_batch(draw(st.integers(0, 2**32 - 1)), grid, draw(st.integers(1, 3)), channels,
                        draw(st.sampled_from([0.0, 0.2, 0.5, 0.8, 1.0])))


def leaf_index(structure: Structure) -> np.ndarray:
    """(B, D, H, W): the leaf of each voxel, by way of `GridOctree`."""
    volumes, first = [], 0
    for trees in structure.trees:
        octree = GridOctree(trees, np.arange(_count(trees), dtype=np.float32)[:, None])  # exact up to 2^24
        volumes.append(octree.to_dense()[0].astype(np.int64) + first)
        first += octree.n_leaves
    return np.stack(volumes)


def _count(trees: np.ndarray) -> int:
    return int(np.bitwise_count(trees).sum()) * 7 + len(trees.reshape(-1, 2))


def expand(batch: OctreeBatch) -> torch.Tensor:
    """(B, C, D, H, W), differentiable."""
    index = torch.from_numpy(leaf_index(batch.structure)).long()
    return batch.features[index].permute(0, 4, 1, 2, 3)


def leaf_average(structure: Structure, dense: torch.Tensor) -> torch.Tensor:
    """(L, C): the mean of a (B, C, D, H, W) volume over each leaf, differentiable."""
    index = torch.from_numpy(leaf_index(structure)).long().reshape(-1)
    rows = dense.permute(0, 2, 3, 4, 1).reshape(len(index), -1)
    total = torch.zeros(structure.n_leaves, rows.shape[1], dtype=dense.dtype).index_add(0, index, rows)
    return total / torch.bincount(index).to(dense.dtype)[:, None]


def widths(structure: Structure) -> np.ndarray:
    """(B, D, H, W): width of the leaf at each voxel, from how many voxels share it."""
    index = leaf_index(structure)
    return np.round(np.cbrt(np.bincount(index.reshape(-1)))).astype(int)[index]


def coarsest(wanted: np.ndarray) -> np.ndarray:
    """(B, D, H, W) widths of the coarsest octree none of whose leaves is wider than wanted at any voxel."""
    result = np.ones_like(wanted)
    for w in (2, 4, 8):
        for b, *corner in itertools.product(range(len(wanted)), *(range(0, n, w) for n in wanted.shape[1:])):
            box = (b, *(slice(i, i + w) for i in corner))
            if wanted[box].min() >= w:
                result[box] = w
    return result


@pytest.fixture(scope="session")
def batches() -> Callable[..., st.SearchStrategy[OctreeBatch]]:
    """Strategy: `data.draw(batches(channels=None, even=False))`."""
    return random_batches


@pytest.fixture(scope="session")
def make_batch() -> Callable[..., OctreeBatch]:
    """`random_batch(seed, grid, batch_size, channels, likelihood, dtype)`."""
    return random_batch


class Dense:
    """The dense side of the definition."""

    leaf_index = staticmethod(leaf_index)
    expand = staticmethod(expand)
    leaf_average = staticmethod(leaf_average)
    widths = staticmethod(widths)
    coarsest = staticmethod(coarsest)


@pytest.fixture(scope="session")
def dense() -> type[Dense]:
    """The oracle: expand, average over leaves, widths."""
    return Dense


def manifest(target: str = "tsdf") -> Manifest:
    """Two procedural shapes in the test split, one in the validation split."""
    return Manifest.from_dict({
        "schema": 1, "name": "tiny", "seed": 3, "target": target, "resolutions": list(RESOLUTIONS),
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
