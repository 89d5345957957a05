"""Make a data set of your own meshes, without YAML.

    python examples/own_meshes.py OUT chair.obj table.ply lamp.stl

The first meshes are for training, the last fifth of them (one at least) for testing. A run that was stopped
goes on when it is called again.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from ocnf_data import Report, generate
from ocnf_data.manifest import Manifest


def main(arguments: Sequence[str] | None = None) -> Report:
    """Make the data set, and return its account."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("meshes", nargs="+", help=".obj, .ply, .off, .stl or .glb; two or more")
    parser.add_argument("--resolutions", type=int, nargs="+", default=[64, 128])
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args(arguments)

    paths = [Path(mesh).absolute() for mesh in options.meshes]
    root = os.path.commonpath([path.parent for path in paths])
    items = [{"path": path.relative_to(root).as_posix(), "category": "mine"} for path in paths]
    n_test = max(1, len(items) // 5)
    manifest = Manifest.from_dict({  # every field that is left out has the paper's setting (docs/manifest.md)
        "name": "own-meshes",
        "source": {"kind": "list", "items": {"train": items[:-n_test], "test": items[-n_test:]}},
        "resolutions": options.resolutions,
        "inputs": [{"name": "noisy", "views": options.views, "sigma": 0.02,
                    "encodings": ["histogram", "tsdf"]}],
    })
    report = generate(manifest, options.out, meshes=root, jobs=options.jobs)
    print(f"{report.samples} samples of {report.items} meshes in {report.out}")
    for failure in report.failures:  # a mesh that cannot be used costs one row, not the run
        print(f"{failure.item}: {failure.message}")
    return report


if __name__ == "__main__":
    main()
