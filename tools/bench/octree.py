"""Time of what GridOctree does at 256^3, beside the authors' dense-to-octree.

    python tools/bench/octree.py [MESH | CATEGORY] [--threads 2]

On the TSDF of 80 views (1 channel) and the histogram of 4 noisy ones (10 channels). Without an argument, a
procedural chair.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
from noisy_octrees import print_table, sample_octrees, timed

from ocnf_data.encodings import Encoding
from ocnf_data.octree import SYMMETRIES, TARGET, GridOctree, mean_on, quantise

PUBLISHED_S = {1: 0.14, 10: 0.44}
"""The authors' dense-to-octree at 256^3 by channels, on the machine of the project's first measurements."""


def main() -> None:
    """Print the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("mesh", nargs="?", default="chair")
    parser.add_argument("--threads", type=int, default=min(2, numba.get_num_threads()))
    arguments = parser.parse_args()
    octrees = sample_octrees(arguments.mesh, (256,))
    numba.set_num_threads(arguments.threads)
    print(f"### {Path(arguments.mesh).stem}, 256^3, {arguments.threads} threads\n")
    with tempfile.TemporaryDirectory() as folder:
        columns = [operations(octrees[kind, 256], kind, Path(folder) / f"{kind}.oc")
                   for kind in (TARGET, str(Encoding.HISTOGRAM))]
        rows = [[name, *(f"{timed(column[name])[0]:.1f}" for column in columns)] for name in columns[0]]
    rows.insert(1, ["the authors' dense to octree", *(f"{1e3 * s:.0f}" for s in PUBLISHED_S.values())])
    titles = [f"{octrees[kind, 256].channels} ch, {octrees[kind, 256].n_leaves:,} leaves: ms"
              for kind in (TARGET, str(Encoding.HISTOGRAM))]
    print_table(f"operation | {' | '.join(titles)}", rows)


def operations(octree: GridOctree, kind: str, path: Path) -> dict[str, Callable[[], object]]:
    """Name -> call, on one octree; `path` is where it may be written."""
    dense = octree.to_dense()
    raw = quantise(octree, kind)
    turn = SYMMETRIES[13]
    voxels = np.random.default_rng(0).integers(0, 256, (1_000_000, 3))
    return {
        "from_dense": lambda: GridOctree.from_dense(dense),
        "to_dense": octree.to_dense,
        "mean_on": lambda: mean_on(octree.trees, dense),
        "validate": lambda: GridOctree(octree.trees, octree.data),
        "leaf_positions": octree.leaf_positions,
        "gather 1 M voxels": lambda: octree.gather(voxels),
        "quantise": lambda: quantise(octree, kind),
        "symmetry, stored dtype (1 thread)": lambda: turn(raw),
        "symmetry, float32 (1 thread)": lambda: turn(octree),
        "write_oc": lambda: octree.write_oc(path),
        "read_oc": lambda: GridOctree.read_oc(path),
    }


if __name__ == "__main__":
    main()
