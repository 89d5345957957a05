"""An input encoding of your own, out of the views that a data set's inputs were made of.

    python examples/own_encoding.py OUT ENCODED [--meshes DIR]

The encoding: of the views that look at a voxel, the share that sees past it, that ends near it, and that is
blocked before it. Each sample becomes ENCODED/KEY.npz with `inputs` (3, D, H, W) and `target` (1, D, H, W).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ocnf_data import Views
from ocnf_data.generation.remake import remake
from ocnf_data.manifest import Manifest
from ocnf_data.shards import load_dataset
from ocnf_data.shards.browse import stored_samples


def visibility(views: Views, resolution: int, extent: float, near: float) -> np.ndarray:
    """(3, D, H, W) float32 shares of the views; 0, 0, 0 where no view looks. `near` in metres."""
    at = (np.arange(resolution) + 0.5) * extent / resolution - extent / 2
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    votes = np.zeros((3, *z.shape), np.float32)
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        camera = np.stack([x, y, z], -1) @ R.T + T  # x right, y down, z forward, metres
        u, v, w = np.moveaxis(camera @ K.T, -1, 0)
        u, v = np.floor(u / w + 0.5).astype(int), np.floor(v / w + 0.5).astype(int)
        seen = (w > 0) & (u >= 0) & (v >= 0) & (u < views.size[1]) & (v < views.size[0])
        measured = np.where(seen, depth[np.where(seen, v, 0), np.where(seen, u, 0)], 0)
        past = measured - w  # how far the ray goes on behind the voxel
        seen &= measured > 0  # 0 is a pixel without a measurement, inf a ray that hits nothing
        votes += np.stack([past > near, np.abs(past) <= near, past < -near]) & seen
    return votes / np.maximum(votes.sum(axis=0), 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a file for each sample."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    for name in ("data", "out", "--meshes"):
        parser.add_argument(name)
    options = parser.parse_args(arguments)
    manifest = Manifest.from_dict(load_dataset(options.data).manifest)
    resolution, variant = manifest.resolutions[0], manifest.inputs[0]
    Path(options.out).mkdir(parents=True, exist_ok=True)
    for sample in stored_samples(options.data):
        views = remake(manifest, sample.facts, manifest.meshes_root(options.meshes)).observed[variant.name]
        inputs = visibility(views, resolution, manifest.normalise.extent, manifest.truncation(resolution))
        target = sample.octree(f"target-{resolution}.oct").to_dense()
        np.savez_compressed(Path(options.out) / f"{sample.key}.npz", inputs=inputs, target=target)


if __name__ == "__main__":
    main()
