"""How far outside of the true surface a reconstruction lies, on average, for each input of a data set.

    python tools/bench/offset.py OUT --run pretrained --split test

The true TSDF is read at the vertices of each method's surface: positive is outwards. In voxels of the finest
resolution; vertices beyond the truncation distance are left out. The data set needs the encodings `histogram`
(or the network's own) and `tsdf`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.ndimage import map_coordinates

from ocnf_data import ShardDataset, octree_surface
from ocnf_data.arrays import F32
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree
from ocnf_data.shards.dataset import load_dataset
from ocnf_model import load_network
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.training.batches import make_example

_NEAR = 0.95  # of the truncation distance


def offsets(octree: GridOctree, truth: F32, truncation_voxels: float) -> tuple[float, float, float]:
    """Mean and median signed distance of a surface from the true one, and the mean of its size; voxels."""
    vertices, _ = octree_surface(octree, float(max(octree.shape)))  # voxels around the centre; x, y, z
    places = vertices[:, ::-1] + (np.array(octree.shape) - 1) / 2
    signed = map_coordinates(truth, places.T, order=1)
    signed = signed[np.abs(signed) < _NEAR] * truncation_voxels
    return float(signed.mean()), float(np.median(signed)), float(np.abs(signed).mean())


@torch.no_grad()
def surfaces(data: str, split: str, variant: str, network: OctNetFusion,
             resolutions: list[int]) -> Iterator[tuple[str, GridOctree, F32]]:
    """Method, reconstruction and true TSDF (D, H, W) of every sample."""
    for method, encoding in (("VolFus", "tsdf"), ("network", str(network.encoding))):
        for batch in ShardDataset(data, split, resolutions, encoding, variant=variant, shuffle=False,
                                  uneven="exact"):
            example = make_example(batch, Output.TSDF, Output.TSDF, torch.device("cpu"))
            found = example.inputs[-1] if method == "VolFus" else network(example.inputs)[-1]
            (octree,) = found.with_features(found.features.clamp(-1, 1)).to_grids()
            yield method, octree, example.target.to_dense()[0, 0].numpy()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--run", default="pretrained")
    parser.add_argument("--split", default="test")
    arguments = parser.parse_args()
    manifest = Manifest.from_dict(load_dataset(str(arguments.data)).manifest)
    trained = load_network(arguments.run, device="cpu")
    table = Table(title="signed distance to the true surface, voxels, outwards")
    for heading in ("input", "method", "mean", "median", "mean size", "models"):
        table.add_column(heading, justify="left" if heading in ("input", "method") else "right")
    for variant in (variant.name for variant in manifest.inputs):
        rows: dict[str, list[tuple[float, float, float]]] = {}
        for method, octree, truth in surfaces(str(arguments.data), arguments.split, variant, trained.module,
                                              trained.resolutions):
            rows.setdefault(method, []).append(offsets(octree, truth, manifest.truncation_voxels))
        for method, found in rows.items():
            mean, median, size = np.mean(found, axis=0)
            table.add_row(variant, method, f"{mean:+.2f}", f"{median:+.2f}", f"{size:.2f}", str(len(found)))
    Console().print(table)


if __name__ == "__main__":
    main()
