"""The doctor: right pictures pass, wrong ones and crashes do not, and every trouble comes with its remedy."""

from __future__ import annotations

import io
import re
import sys
import tomllib
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from ocnf_data import doctor
from ocnf_data.doctor import Check, Status

GOOD = {"p99": 1e-7, "wrong": 0, "pixels": 10_000, "ms": 1.0, "by": "numba, 1 thread"}


def _named(checks: list[Check], name: str) -> Check:
    return next(check for check in checks if check.name == name)


def test_this_machine() -> None:
    """The z-buffer has to work wherever the tests run; OpenGL wherever libEGL is installed."""
    checks = doctor.diagnose()
    raster = _named(checks, "render: raster")
    assert raster.status is Status.OK, raster
    egl = _named(checks, "render: pyrender on EGL")
    assert egl.status is (Status.OK if find_library("EGL") else Status.WARNING), egl
    assert {"Python", "machine", "disk", "libraries: core"} <= {check.name for check in checks}
    for check in checks:
        assert check.status in (Status.OK, Status.NOTE) or check.fix


def test_it_looks_for_what_the_package_asks_for() -> None:
    """Each requirement in pyproject.toml, of the extras that people use; and nothing that no extra has."""
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    asked = {"core": project["dependencies"], **project["optional-dependencies"]}
    for extra, names in doctor._LIBRARIES.items():
        wanted = {re.split(r"[\[>=]", requirement)[0] for requirement in asked[extra]}
        looked_for = {"dask" if name == "distributed" else name for name in names} - {"PyOpenGL"}
        assert looked_for == wanted, extra


def test_the_probe_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    right = doctor.render_depth
    report = doctor.probe("raster")
    assert report["p99"] < 1e-6
    assert report["wrong"] == 0

    def shifted(vertices: Any, faces: Any, K: np.ndarray, *rest: Any) -> np.ndarray:
        return right(vertices, faces, np.add(K, [[0, 0, 0.5], [0, 0, 0], [0, 0, 0]]), *rest)

    def culled(vertices: Any, faces: np.ndarray, *rest: Any) -> np.ndarray:
        return right(vertices, faces[:-2], *rest)

    for wrong in (shifted, culled):
        monkeypatch.setattr(doctor, "render_depth", wrong)
        check = doctor._judged("x", doctor.probe("raster"), Status.FAILURE, "y")
        assert check.status is Status.FAILURE


@pytest.mark.parametrize(("code", "problem"), [
    ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "crashed with SIGSEGV"),
    ("raise OSError('no such device')", "failed: OSError: no such device"),
    ("import time; time.sleep(60)", "gave no picture within 1 s"),
])
def test_crashes_and_hangs(monkeypatch: pytest.MonkeyPatch, code: str, problem: str) -> None:
    monkeypatch.setattr(doctor, "_TIMEOUT", 1.0 if "sleep" in code else 60.0)
    run = doctor.subprocess.run
    command = [sys.executable, "-c", code]
    monkeypatch.setattr(doctor.subprocess, "run", lambda _, **settings: run(command, **settings))
    check = doctor._raster()
    assert (check.status, check.found) == (Status.FAILURE, problem)
    assert check.fix


@pytest.mark.parametrize(("report", "fix"), [
    ({"problem": "the module pyrender is not installed"}, "pip install 'ocnf[gl]'"),
    ({"problem": "OpenGL gives no context on egl"}, "apt-get install libegl1 libgl1 libxrender1"),
])
def test_missing_opengl_is_a_warning(monkeypatch: pytest.MonkeyPatch, report: dict, fix: str) -> None:
    monkeypatch.setattr(doctor.ctypes.util, "find_library", lambda name: name)
    answers = {"raster": GOOD, "pyrender": report}
    monkeypatch.setattr(doctor, "_try_in_child", lambda backend, **env: answers[backend])
    egl = _named(doctor.diagnose(), "render: pyrender on EGL")
    assert (egl.status, egl.fix) == (Status.WARNING, fix)
    screen = io.StringIO()
    assert doctor.run_doctor(Console(file=screen, width=200)) == 0
    assert fix in screen.getvalue()


def test_broken_rasteriser_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_try_in_child", lambda backend, **env: GOOD | {"wrong": 400})
    assert doctor.run_doctor(Console(file=io.StringIO())) == 1
