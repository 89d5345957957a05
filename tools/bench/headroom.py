"""What holds a network back: meshes it has not seen, its passes, or the noise?

    python tools/bench/headroom.py OUT [--run pretrained] [--splits train val] [--inputs v4_n02 v4_n00]

Of each split and input of a data set, made of the meshes that the network was trained on: the MAD beside
VolFus's, in all and by region, and the MAD of the mean over the cube's eight mirror images, each of which the
network sees anew. If a split that it was trained on is no better than another, more meshes would not help; if
a mean of eight is no better, its mistakes are not by chance; and what is left without noise is what few views
do not tell of the truth of eighty. The data set needs histograms.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import islice, product
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from ocnf_data import ShardDataset
from ocnf_data.encodings import Encoding
from ocnf_data.manifest import Manifest
from ocnf_data.octree import SYMMETRIES, GridOctree
from ocnf_data.shards.dataset import load_dataset
from ocnf_model.checkpoint import TrainedRun, open_run
from ocnf_model.evaluation.levels import run_levels
from ocnf_model.measures.regions import Regions, mad_by_region, seen_by
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.ops.blend import plain_tsdf
from ocnf_model.training.batches import make_example

MIRRORS = SYMMETRIES[:8]
"""Those that exchange no axes: the first one moves nothing, and each undoes itself."""


def main() -> None:
    """Print the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("data", type=Path)
    parser.add_argument("--run", default="pretrained")
    parser.add_argument("--splits", nargs="+", default=["train", "val"])
    parser.add_argument("--inputs", nargs="+", default=["v4_n02", "v4_n00"])
    parser.add_argument("--level", type=int, default=1)
    parser.add_argument("--samples", type=int, default=100, help="of each split")
    options = parser.parse_args()
    run = open_run(options.run, options.level)
    manifest = Manifest.from_dict(load_dataset(str(options.data)).manifest)
    run.check_truncation(str(options.data), manifest.truncation_voxels)
    regions = [name.replace("_", " ") for name in Regions.__dataclass_fields__]
    table = Table(title=f"MAD in mm at {run.resolutions[-1]}³, and by region: {options.run} / VolFus")
    for heading in ("split", "input", "samples", "MAD", "ratio", "mean of 8", *regions):
        table.add_column(heading, justify="left" if heading in ("split", "input") else "right")
    for split, name in product(options.splits, options.inputs):
        found = np.array(list(islice(figures(run, options.data, split, name), options.samples)))
        ours, theirs, mirrored = found[:, 0].mean(0), found[:, 1].mean(0), found[:, 2].mean(0)
        parts = (f"{a:.3f} / {b:.3f}" for a, b in zip(ours, theirs, strict=True))
        table.add_row(split, name, str(len(found)), f"{ours.sum():.3f}", f"{ours.sum() / theirs.sum():.3f}",
                      f"{mirrored.sum():.3f}", *parts)
    Console(width=None if Console().is_terminal else 200).print(table)


@torch.no_grad()
def figures(run: TrainedRun, data: Path, split: str, name: str) -> Iterator[list[np.ndarray]]:
    """Of each sample the MAD by region (6,) in mm: the network's, VolFus's, and that by mirror images."""
    tau, read = run.data.tau(run.resolutions[-1]), run.network.reads(run.resolutions)
    for batch in ShardDataset(str(data), split, read, Encoding.HISTOGRAM, variant=name,
                              targets=run.resolutions[-1:], uneven="exact"):
        example = make_example(batch, Output.TSDF, Output.TSDF, torch.device("cpu"))
        encoded = example.encoded
        seen = seen_by(encoded, Encoding.HISTOGRAM)
        assert seen is not None
        once = reconstruction(run.network, example.inputs)
        fused = encoded.with_features(plain_tsdf(encoded.features, Encoding.HISTOGRAM))
        yield [mad_by_region(volume, example.target, seen, tau)[0].numpy()
               for volume in (once, fused, by_mirrors(run.network, example.inputs))]


def by_mirrors(network: OctNetFusion, inputs: Sequence[OctreeBatch]) -> OctreeBatch:
    """The mean of what the network makes of the eight mirror images of a sample."""
    total = np.zeros((1, *inputs[len(network.levels) - 1].shape), np.float32)
    for mirror in MIRRORS:
        moved = [OctreeBatch.from_grids([mirror(grid) for grid in encoded.to_grids()]) for encoded in inputs]
        (found,) = reconstruction(network, moved).to_grids()
        total += mirror(found).to_dense()  # (1, D, H, W)
    return OctreeBatch.from_grids([GridOctree.from_dense(total / np.float32(len(MIRRORS)))])


def reconstruction(network: OctNetFusion, inputs: Sequence[OctreeBatch]) -> OctreeBatch:
    """TSDF / tau of the last level, from -1 to 1."""
    *_, reached = run_levels(network, inputs, torch.device("cpu"))
    return reached.reconstruction.with_features(reached.reconstruction.features.clamp(-1, 1))


if __name__ == "__main__":
    main()
