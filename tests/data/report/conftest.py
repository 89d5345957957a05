"""A data set of three meshes and one that is broken, and its page."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

from ocnf_data.generation import generate
from ocnf_data.manifest import Manifest
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.report.run import write_report
from ocnf_data.shapes import make_shape


class Made(NamedTuple):
    """A data set, the meshes it was made from, and its page with every triangle."""

    meshes: Path
    data: Path
    page: Path


def own_manifest(**changes: object) -> Manifest:
    return Manifest.from_dict({
        "name": "own", "source": {"kind": "folder", "shares": {"train": 1.0}},
        "camera": {"rig": "fibonacci8", "width": 80, "height": 60, "fx": 44, "fy": 44, "cx": 40, "cy": 30},
        "resolutions": [16, 32], "shards": {"samples": 2}, "limits": {"failure_threshold": 1.0},
        "inputs": [{"name": "v3", "views": 3, "sigma": 0.02, "encodings": ["histogram", "tsdf"]},
                   {"name": "occ", "views": 2, "sigma": 0.01, "encodings": ["occupancy"]}], **changes})


@pytest.fixture(scope="session")
def report_made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("report")
    for name, category in (("a", "chair"), ("b", "mug"), ("c", "mug")):
        (folder / "meshes" / category).mkdir(parents=True, exist_ok=True)
        mesh = make_shape(category, 0, ord(name), "train")
        (folder / "meshes" / category / f"{name}.ply").write_bytes(
            WRITERS[".ply"](mesh.vertices, mesh.faces, None))
    (folder / "meshes" / "mug" / "broken.off").write_text("OFF\n3 1 0\n0 0 0\n")
    report = generate(own_manifest(), folder / "OUT", folder / "meshes", progress=False)
    assert (report.samples, len(report.failures)) == (3, 1)
    made = Made(folder / "meshes", folder / "OUT", folder / "page.html")
    done = write_report(str(made.data), made.page, meshes=made.meshes, triangles=10**6)
    assert done.paths == [made.page] and done.n_samples == 3 and not done.failures
    return made
