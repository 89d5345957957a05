"""A data set of a ball and a box, whose surfaces and distances are known."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ocnf_data.files.storage import Store
from ocnf_data.octree import GridOctree, encode

EXTENT = 3.0
CENTRE, SCALE = np.array([10.0, -2.0, 0.5]), 1.25  # of the mesh file: metres = (v - CENTRE) * SCALE
BALL_AT, RADIUS = np.array([0.2, -0.1, 0.3]), 0.8
HALF = np.array([0.9, 0.6, 0.4])  # of the box, x y z


def ball(points: np.ndarray, radius: float = RADIUS) -> np.ndarray:
    """Distance of points (..., 3), x y z in metres, from a ball off the centre."""
    return np.linalg.norm(points - BALL_AT, axis=-1) - radius


def box(points: np.ndarray) -> np.ndarray:
    """Distance from a box around the origin."""
    out = np.abs(points) - HALF
    return np.linalg.norm(np.maximum(out, 0), axis=-1) + np.minimum(out.max(axis=-1), 0)


def truncation(resolution: int) -> float:
    return 32 / 15 * EXTENT / resolution


def field(distance: Callable[[np.ndarray], np.ndarray], resolution: int) -> np.ndarray:
    """(1, D, H, W) float32 TSDF / tau at the voxels' centres."""
    at = (np.arange(resolution) + 0.5) * EXTENT / resolution - EXTENT / 2
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    tau = truncation(resolution)
    return np.clip(distance(np.stack([x, y, z], -1)) / tau, -1, 1).astype(np.float32)[None]


def histogram(resolution: int) -> np.ndarray:
    bins = np.random.default_rng(5).integers(0, 10, (resolution // 8,) * 3)
    bins = bins.repeat(8, 0).repeat(8, 1).repeat(8, 2)
    return np.moveaxis(np.eye(10, dtype=np.float32)[bins], -1, 0).copy()


def make_sample(key: str, category: str, distance: Callable[[np.ndarray], np.ndarray], split: str,
                resolutions: tuple[int, ...] = (32, 64),
                target: str = "tsdf") -> tuple[str, dict[str, bytes]]:
    """The members of a sample: the ground truth, and as inputs a smaller ball's TSDF and a histogram."""
    octrees = {}
    for resolution in resolutions:
        truth = field(distance, resolution)
        if target == "occupancy":
            truth = (truth < 0).astype(np.float32)
        octrees[f"target-{resolution}.oct"] = truth, "target"
        smaller = field(lambda points: ball(points, RADIUS / 2), resolution)
        octrees[f"v2-tsdf-{resolution}.oct"] = smaller, "tsdf"
        octrees[f"v2-histogram-{resolution}.oct"] = histogram(resolution), "histogram"
    grids = {name: (GridOctree.from_dense(values), kind) for name, (values, kind) in octrees.items()}
    facts = {"key": key, "category": category, "source": f"{key}.off", "split": split, "target": target,
             "leaf_counts": {name: grid.n_leaves for name, (grid, _) in grids.items()},
             "normalisation": {"centre": CENTRE.tolist(), "scale": SCALE, "extent": EXTENT},
             "truncation": {str(resolution): truncation(resolution) for resolution in resolutions}}
    return key, {"json": json.dumps(facts).encode(),
                 **{name: encode(grid, kind) for name, (grid, kind) in grids.items()}}


@pytest.fixture(scope="session")
def known() -> SimpleNamespace:
    """The shapes and lengths above."""
    return SimpleNamespace(ball=ball, box=box, field=field, histogram=histogram, truncation=truncation,
                           extent=EXTENT, centre=CENTRE, scale=SCALE, radius=RADIUS, sample=make_sample)


@pytest.fixture(scope="session")
def _shapes() -> dict[str, list[list[tuple[str, dict[str, bytes]]]]]:
    return {"train": [[make_sample("ball_1", "ball", ball, "train"),
                       make_sample("box_1", "box", box, "train")],
                      [make_sample("ball_2", "ball", ball, "train", (32,))]],
            "test": [[make_sample("box_2", "box", box, "test")]]}


@pytest.fixture
def shapes(write_set: Callable[..., Store], _shapes: dict, tmp_path: Path) -> Store:
    """Two training shards (ball_1 and box_1, ball_2 of 32^3 alone), and a test shard (box_2)."""
    return write_set(_shapes, tmp_path / "shapes")
