"""Without an extra, a command says in one line that can be pasted which one it lacks."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize(("library", "extra", "code"), [
    ("cv2", "fuse", "from pathlib import Path; from ocnf_data.views.scans.images import read_depth; "
                    "read_depth(Path('a.png'))"),
    ("skimage", "fuse", "from ocnf_data import GridOctree, octree_surface; "
                        "octree_surface(GridOctree.from_dense(np.full((1, 8, 8, 8), -1, np.float32)))"),
    ("fast_simplification", "fuse", "from ocnf_model.scan.run import Asked, Path, run_fuse; "
                                    "run_fuse('SCAN', Asked(Path('a.ply'), faces=9))"),
    ("matplotlib", "fuse", "from ocnf_model.scan.run import Asked, Path, run_fuse; "
                           "run_fuse('SCAN', Asked(None, preview=Path('a.png')))"),
    ("h5py", "fuse", "from ocnf_data import read_scan; read_scan('views.h5::key')"),
    ("matplotlib", "generate", "from ocnf_data.inspection.stats import draw; draw({'coverage': {}}, None)"),
    ("fast_simplification", "generate", "from ocnf_data.report.geometry import Triangles, simplify; "
                                        "simplify(Triangles(np.zeros((3, 3)), np.zeros((9, 3), int)), 1)"),
    ("rerun", "rerun", "from pathlib import Path; from ocnf_data.report.recording import Recording; "
                       "Recording(Path('a.rrd'), None, 'z')"),
    ("joblib", "generate", "from ocnf_data import generate, load_manifest; "
                           "generate(load_manifest('demo.yaml'), 'OUT', jobs=2)"),
    ("sklearn", "completion", "from ocnf_model.completion.forest import StructuredForest; "
                              "StructuredForest([])"),
])
def test_the_last_line_can_be_pasted(tmp_path: Path, library: str, extra: str, code: str) -> None:
    """In a process that cannot import the library."""
    (tmp_path / "demo.yaml").write_text((ROOT / "manifests/demo.yaml").read_text())
    (tmp_path / "views.h5").touch()
    cv2.imwrite(str(tmp_path / "a.png"), np.ones((2, 2), np.uint16))
    program = (f"import sys; sys.modules['{library}'] = None\n"
               f"import numpy as np, typer\nfrom rich.console import Console\n"
               f"from ocnf_data.terminal import run_app\ndef app():\n    {code}\n"
               "run_app(app, Console(stderr=True), lambda: False)")
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True,
                          env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
    assert done.returncode == 1, done.stderr
    *_, last = done.stderr.splitlines()
    assert last == f"pip install 'ocnf[{extra}]'", done.stderr
    assert library not in _distributions(()) and library in _distributions((extra,))


def _distributions(extras: tuple[str, ...]) -> set[str]:
    """What the core and some extras declare, by the names that are imported."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    modules = {"opencv-python-headless": "cv2", "scikit-image": "skimage",
               "fast-simplification": "fast_simplification", "rerun-sdk": "rerun",
               "scikit-learn": "sklearn"}
    declared = [*project["dependencies"],
                *(line for extra in extras for line in project["optional-dependencies"][extra])]
    names = {line.split(">")[0].split("=")[0].split("[")[0] for line in declared}
    return {modules.get(name, name) for name in names}


def test_both_command_lines_tell_the_version() -> None:
    from ocnf_data import __version__

    for module in ("ocnf_data.cli", "ocnf_model.cli"):
        done = subprocess.run([sys.executable, "-m", module, "--version"], capture_output=True, text=True,
                              env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True)
        assert done.stdout == f"ocnf {__version__}\n"
