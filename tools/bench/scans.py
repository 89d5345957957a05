"""Surfaces of a few frames of a scan, by each method, against plain fusion of all its frames.

    python tools/bench/scans.py SCAN --frames 10 20

At 256^3, in the largest object of the scan. Accuracy is the mean distance from the surface to the reference,
completeness that from the reference to the surface, F-score the harmonic mean of the shares within one voxel.
The reference holds the frames of the input too, as is usual where a scan is all there is.
"""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table

from ocnf_data.fusion import DepthPyramid
from ocnf_data.views.scans import read_scan
from ocnf_model.checkpoint import SHIPPED, open_run
from ocnf_model.evaluation.methods import default_weight
from ocnf_model.measures.figures import f_score
from ocnf_model.measures.surface import Surface, sample_triangles
from ocnf_model.scan.fuse import choose_region, reconstruct
from ocnf_model.scan.fusers import Baseline, Fuser, Learned
from ocnf_model.scan.reconstruction import Reconstruction

_RESOLUTION = 256
_SAMPLES = 30_000


def surface_of(found: Reconstruction) -> Surface:
    """The surface in metres, a part a triangle."""
    triangles = found.vertices[found.faces].astype(np.float32)  # (M, 3, 3)
    return Surface(triangles, np.arange(len(triangles) + 1), triangles.mean(axis=1))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan")
    parser.add_argument("--frames", nargs="+", type=int, default=[10, 20])
    arguments = parser.parse_args()
    everything = read_scan(arguments.scan)
    pyramid = DepthPyramid(everything.views)
    region = choose_region(everything, pyramid, None, room=False)
    plain = Baseline(_RESOLUTION)
    reference = surface_of(reconstruct(everything, pyramid, plain, region))
    voxel = region.size / _RESOLUTION
    true = sample_triangles(reference.triangles, _SAMPLES).points
    methods: dict[str, Fuser] = {"VolFus": plain, "TV-L1": Baseline(_RESOLUTION, default_weight(_RESOLUTION))}
    methods |= {name: Learned.of(open_run(name), None) for name in SHIPPED}
    table = Table(title=f"{arguments.scan}: {len(everything.views)} frames, voxels of {1000 * voxel:.2f} mm")
    for heading in ("frames", "method", "accuracy mm", "completeness mm", "F-score"):
        table.add_column(heading, justify="left" if heading == "method" else "right")
    for n in arguments.frames:
        scan = read_scan(arguments.scan, frames=str(n))
        views = DepthPyramid(scan.views)
        for name, fuser in methods.items():
            found = surface_of(reconstruct(scan, views, fuser, region))
            there = sample_triangles(found.triangles, _SAMPLES).points
            table.add_row(str(n), name, f"{1000 * reference.nearest(there)[0].mean():.2f}",
                          f"{1000 * found.nearest(true)[0].mean():.2f}",
                          f"{f_score(found, reference, voxel):.3f}")
        table.add_section()
    Console().print(table)


if __name__ == "__main__":
    main()
