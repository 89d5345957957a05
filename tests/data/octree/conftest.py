"""An oracle for octrees, written as slowly and plainly as possible, and strategies that draw valid ones."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import strategies as st

from ocnf_data.octree import GridOctree


def walk(split: Callable[[int, int, int, int, int], bool], z: int, y: int, x: int) -> tuple[int, list]:
    """Bits of one tree, as a Python integer, and its leaves (z, y, x, width) in order; breadth first."""
    bits, leaves, level = 0, [], [(0, z, y, x)]
    for width in (8, 4, 2, 1):
        below = []
        for i, z, y, x in level:
            if width == 1 or not split(i, z, y, x, width):
                leaves.append((z, y, x, width))
                continue
            bits |= 1 << i
            half = width // 2
            corners = itertools.product((z, z + half), (y, y + half), (x, x + half))
            below += [(8 * i + 1 + k, *corner) for k, corner in enumerate(corners)]
        level = below
    return bits, leaves


def from_dense_slowly(values: np.ndarray, tolerance: float) -> tuple[list[int], np.ndarray]:
    """(C, D, H, W) -> bits of each tree as Python integers, leaf rows (n_leaves, C) float32."""
    values = values.astype(np.float64)

    def block(z: int, y: int, x: int, width: int) -> np.ndarray:
        return values[:, z : z + width, y : y + width, x : x + width].reshape(len(values), -1)

    def split(_: int, z: int, y: int, x: int, width: int) -> bool:
        node = block(z, y, x, width)
        return bool((node.max(axis=1) - node.min(axis=1) > tolerance).any())

    trees, rows = [], []
    for origin in itertools.product(*(range(0, n, 8) for n in values.shape[1:])):
        bits, leaves = walk(split, *origin)
        trees.append(bits)
        rows += [block(*leaf).mean(axis=1) for leaf in leaves]
    return trees, np.array(rows).astype(np.float32)


def as_integers(octree: GridOctree) -> list[int]:
    """Bits of each tree as Python integers."""
    return [int(lo) | int(hi) << 64 for lo, hi in octree.trees.reshape(-1, 2)]


@st.composite
def random_octrees(draw: st.DrawFn, channels: int | None = None, low: float = -1.0) -> GridOctree:
    """Octrees of any structure, built bit by bit; all-leaf and all-split trees are likely."""
    grid = draw(st.tuples(*[st.integers(1, 3)] * 3))
    likelihood = draw(st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    trees, n_leaves = [], 0
    for _ in range(int(np.prod(grid))):
        bits, leaves = walk(lambda *_: bool(rng.random() < likelihood), 0, 0, 0)
        trees.append([bits & (2**64 - 1), bits >> 64])
        n_leaves += len(leaves)
    if channels is None:
        channels = draw(st.integers(1, 3))
    data = rng.uniform(low, 1.0, (n_leaves, channels)).astype(np.float32)
    exact = rng.random(data.shape) < 0.3
    data[exact] = rng.choice(np.array([low, 0.0, 1.0], np.float32), exact.sum())
    return GridOctree(np.array(trees, np.uint64).reshape(*grid, 2), data)


@pytest.fixture(scope="session")
def octrees() -> Callable[..., st.SearchStrategy[GridOctree]]:
    """Strategy: `data.draw(octrees(channels=None, low=-1.0))`."""
    return random_octrees


@pytest.fixture(scope="session")
def slow_from_dense() -> Callable[[np.ndarray, float], tuple[list[int], np.ndarray]]:
    """The oracle of `GridOctree.from_dense`."""
    return from_dense_slowly


@pytest.fixture(scope="session")
def bits_of() -> Callable[[GridOctree], list[int]]:
    """Bits of each tree as Python integers."""
    return as_integers


@pytest.fixture(scope="session")
def walk_tree() -> Callable[..., tuple[int, list]]:
    """The plain walk over one tree."""
    return walk


@pytest.fixture
def golden() -> tuple[np.ndarray, GridOctree]:
    """8 x 8 x 16 voxels, worked out by hand: volume (1, 8, 8, 16) and octree.

    The tree at x < 8 is one leaf of value 1. In the other, the 4^3 node k = 5 (z 4-7, y 0-3, x 12-15) is
    split, and in it the 2^3 node k = 3 (z 4-5, y 2-3, x 14-15), whose voxels are 10..17 in (z, y, x) order;
    so are the last 4^3 node and its last 2^3 node (z 6-7, y 6-7, x 14-15), whose voxels are 20..27. The rest
    is 2.
    Bits: root 0; 4^3 nodes 1 + 5 = 6 and 1 + 7 = 8; 2^3 nodes 8 * 6 + 1 + 3 = 52 and 8 * 8 + 1 + 7 = 72.
    Leaves: 1, then 6 of width 4, 14 of width 2, 16 voxels.
    """
    volume = np.full((1, 8, 8, 16), 2, np.float32)
    volume[..., :8] = 1
    volume[0, 4:6, 2:4, 14:16] = np.arange(10, 18).reshape(2, 2, 2)
    volume[0, 6:8, 6:8, 14:16] = np.arange(20, 28).reshape(2, 2, 2)
    trees = np.zeros((1, 1, 2, 2), np.uint64)
    trees[0, 0, 1] = [1 << 0 | 1 << 6 | 1 << 8 | 1 << 52, 1 << 72 - 64]
    data = np.array([1, *[2] * 6, *[2] * 14, *range(10, 18), *range(20, 28)], np.float32)[:, None]
    return volume, GridOctree(trees, data)
