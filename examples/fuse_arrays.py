"""Fuse depth frames that you hold in arrays into an octree, and cut a mesh out of it.

    python examples/fuse_arrays.py ball.ply

The frames here are computed: twelve looks at a ball. Put your own `depth`, `K` and `poses` in their place.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ocnf_data import fuse_histogram, fuse_tsdf
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.octree.surface import octree_surface
from ocnf_data.views.rigs import fibonacci, intrinsics, look_from
from ocnf_data.views.scans import Scan


def frames(radius: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (V, H, W) along z in metres, K (3, 3), poses (V, 4, 4) from camera to world, OpenCV axes."""
    size, K = (120, 160), intrinsics(88, 88, 80, 60)
    R, T = look_from(fibonacci(12), 3.0)
    v, u = np.indices(size)
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(size)], -1)
    # |t ray - middle| = radius, where t is the depth along z and T the ball's middle as the camera sees it.
    a, b = (ray ** 2).sum(-1), ray @ T.T
    root = b ** 2 - a[..., None] * ((T ** 2).sum(-1) - radius ** 2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a[..., None], np.inf)  # inf: a free ray
    poses = np.tile(np.eye(4), (len(R), 1, 1))
    poses[:, :3, :3] = R.transpose(0, 2, 1)
    poses[:, :3, 3] = -(R.transpose(0, 2, 1) @ T[..., None])[..., 0]
    return np.moveaxis(depth, -1, 0), K, poses


def main(arguments: Sequence[str] | None = None) -> np.ndarray:
    """Write the mesh, and return its vertices (N, 3) in metres."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("mesh")
    parser.add_argument("--resolution", type=int, default=128)
    options = parser.parse_args(arguments)

    depth, K, poses = frames()
    scan = Scan.from_arrays(depth, K, poses)  # depth_scale=1000 for whole millimetres
    print(f"{len(scan.views)} frames; {scan.agreement}", *scan.warnings, sep="\n")
    octree = fuse_tsdf(scan.views, options.resolution, extent=3.0)  # a cube of 3 m around the origin
    print(octree, fuse_histogram(scan.views, 64), sep="\n")
    vertices, faces = octree_surface(octree, extent=3.0)
    Path(options.mesh).write_bytes(WRITERS[".ply"](vertices, faces))
    return vertices


if __name__ == "__main__":
    main()
