"""Export a data set as points, and read them as trainers of implicit surfaces do.

    python examples/export_points.py OUT POINTS

POINTS/occupancy_networks is a data folder for Occupancy Networks and Convolutional Occupancy Networks,
POINTS/deepsdf one for DeepSDF (docs/export.md).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from ocnf_data.export import export_dataset


def occupancies(folder: Path, split: str) -> Iterator[tuple[str, torch.Tensor, torch.Tensor, torch.Tensor]]:
    """(key, surface points (N, 3), query points (M, 3), 1 inside and 0 outside (M,)) of each sample."""
    for listing in sorted(folder.glob(f"*/{split}.lst")):
        for key in listing.read_text().split():
            with np.load(listing.parent / key / "pointcloud.npz") as surface:
                cloud = torch.from_numpy(surface["points"])
            with np.load(listing.parent / key / "points.npz") as queries:
                points = torch.from_numpy(queries["points"])
                inside = np.unpackbits(queries["occupancies"])[: len(points)]
            yield key, cloud, points, torch.from_numpy(inside.astype(np.float32))


def main(arguments: Sequence[str] | None = None) -> int:
    """Export, show a line for each training sample, and return how many there are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("out")
    parser.add_argument("--points", type=int, default=100_000)
    options = parser.parse_args(arguments)

    report = export_dataset(options.data, options.out, "points", points=options.points)
    print(report)
    n = 0
    for key, cloud, points, inside in occupancies(Path(options.out) / "occupancy_networks", "train"):
        print(f"{key}: {len(cloud)} surface points, {inside.mean():.1%} of {len(points)} points inside")
        n += 1
    return n


if __name__ == "__main__":
    main()
