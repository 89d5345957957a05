"""TV-L1 to convergence: time, iterations, energy and MAD beside VolFus, on 4 views with 2 % noise.

    python tools/bench/tvl1.py [MESH | CATEGORY ...] [--weights 1 2] [--resolutions 64 256] [--threads 2]

Without arguments, a procedural chair and bed. The gap bounds how far the energy is from its minimum.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numba
from noisy_octrees import print_table, sample_octrees

from ocnf_data.encodings import Encoding
from ocnf_data.fusion import default_truncation
from ocnf_data.octree import TARGET
from ocnf_model.baselines import minimise
from ocnf_model.metrics import grid_mad_mm

SCALE = 1.125  # bin centres in units of l_j tau


def main() -> None:
    """Print a table for each mesh."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("meshes", nargs="*", default=["chair", "bed"])
    parser.add_argument("--weights", type=float, nargs="+", default=[1.0, 2.0, 4.0])
    parser.add_argument("--resolutions", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--threads", type=int, default=min(2, numba.get_num_threads()))
    arguments = parser.parse_args()
    for mesh in arguments.meshes:
        octrees = sample_octrees(mesh, tuple(arguments.resolutions))
        numba.set_num_threads(arguments.threads)
        minimise(octrees[str(Encoding.HISTOGRAM), arguments.resolutions[0]], 1.0, 1)  # compiles
        rows = []
        for resolution in arguments.resolutions:
            histogram = octrees[str(Encoding.HISTOGRAM), resolution]
            truth, tau = octrees[TARGET, resolution], default_truncation(resolution)
            volfus = grid_mad_mm(octrees[str(Encoding.TSDF), resolution], truth, tau)
            for weight in arguments.weights:
                start = time.perf_counter()
                solution = minimise(histogram, weight)
                octree = solution.values(SCALE)
                seconds = time.perf_counter() - start
                rows.append([f"{resolution}^3", f"{weight:g}", f"{seconds:.2f}", str(solution.iterations),
                             f"{len(solution.state.u) * 512 / histogram.leaf_width().size:.1%}",
                             f"{solution.energy:.1f}", f"{solution.gap:.1e}", f"{octree.n_leaves:,}",
                             f"{grid_mad_mm(octree, truth, tau):.4f}", f"{volfus:.4f}"])
        print(f"### {Path(mesh).stem}, {arguments.threads} threads\n")
        print_table("grid | weight | seconds | iterations | voxels stored | energy | gap | leaves | MAD mm | "
                    "VolFus MAD mm", rows)


if __name__ == "__main__":
    main()
