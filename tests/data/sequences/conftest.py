"""Scans on disk of a scene whose depth is known in closed form: a ball in a box-shaped room."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ocnf_data.manifest import Manifest

SIZE = (48, 64)
K = np.array([[40.0, 0, 31.0], [0, 41.0, 23.5], [0, 0, 1]])
ROOM = np.array([[-1.0, -1.2, -0.6], [1.0, 0.8, 0.9]])
BALL, RADIUS = np.array([0.1, -0.2, 0.0]), 0.35
REGION = [-1.1, -1.3, -0.7, 1.1, 0.9, 1.0]


def cast(R: np.ndarray, T: np.ndarray) -> np.ndarray:
    """(H, W) z of the first surface along each pixel's ray, from a camera in the room, by closed formulas."""
    v, u = np.mgrid[:SIZE[0], :SIZE[1]]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u, float)], axis=-1) @ R
    centre = -R.T @ T  # rays have z 1 in the camera's axes, so that a multiple of one is a depth
    with np.errstate(divide="ignore"):
        walls = (np.where(rays > 0, ROOM[1] - centre, centre - ROOM[0]) / np.abs(rays)).min(axis=-1)
    a, b = (rays**2).sum(-1), rays @ (centre - BALL)
    root = b**2 - a * (((centre - BALL) ** 2).sum() - RADIUS**2)
    ball = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    return np.minimum(walls, np.where(ball > 0, ball, np.inf))


def poses(n: int) -> tuple[np.ndarray, np.ndarray]:
    """N cameras on a path around the ball within the room: R (n, 3, 3), T (n, 3), world to camera."""
    angle = np.linspace(0, 5.5, n)
    centres = BALL + np.stack([0.7 * np.cos(angle), 0.7 * np.sin(angle), 0.3 + 0.2 * np.sin(3 * angle)], 1)
    centres = np.clip(centres, ROOM[0] + 0.05, ROOM[1] - 0.05)
    ahead = BALL - centres
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    return R, -np.einsum("vij,vj->vi", R, centres)


def write_scan(folder: Path, n: int) -> Path:
    """A 7-Scenes folder of n frames, in tenths of a millimetre."""
    folder.mkdir(parents=True)
    np.savetxt(folder / "camera-intrinsics.txt", K)
    for i, (R, T) in enumerate(zip(*poses(n), strict=True)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R.T, -R.T @ T
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
        cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), np.rint(cast(R, T) * 10_000).astype(np.uint16))
    return folder


@pytest.fixture(scope="session")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root with the scans `long` (30 frames) and `short` (12), and another folder. Not to be changed."""
    root = tmp_path_factory.mktemp("scans")
    write_scan(root / "long", 30)
    write_scan(root / "short", 12)
    (root / "notes").mkdir()
    return root


def sequence_manifest(rest: dict[str, Any] | None = None, **source: Any) -> Manifest:
    """A manifest of scans: fields of the source, and others of the manifest as a mapping."""
    return Manifest.from_dict({
        "name": "kinect", "seed": 5, "resolutions": [16, 32],
        "source": {"kind": "sequence", "scans": ["long"], "configurations": {"train": 3, "test": 2},
                   "region": REGION, "reading": {"depth_scale": 10_000}, **source},
        "inputs": [{"name": "v2", "views": 2, "encodings": ["tsdf", "histogram"]},
                   {"name": "v5", "views": 5, "encodings": ["histogram"]}],
        "shards": {"samples": 2}, **(rest or {})})
