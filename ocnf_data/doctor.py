"""What works on this machine, tried and not guessed, and how to fix what does not work: `ocnf-data doctor`.

Each render backend draws a box whose depth has a formula, in a child process with a time limit, because
OpenGL may crash or hang. The child is this module: `python -m ocnf_data.doctor BACKEND` prints JSON.
"""

from __future__ import annotations

import ctypes.util
import importlib.metadata
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.render import render_depth
from ocnf_data.render.gl import LIBRARIES, MISSING, OSMESA
from ocnf_data.views.rigs import fibonacci, intrinsics, look_from

_TIMEOUT = 120.0  # seconds; compiling the rasteriser for the first time takes about 15
_MEMORY_PER_CORE = 1 << 30
_DISK = 5 << 30

# What pyproject.toml asks for, which a test sees to.
_LIBRARIES = {
    "core": ("numpy", "numba", "torch", "scipy", "safetensors", "zstandard", "pydantic", "fsspec", "pyyaml",
             "filelock", "rich", "typer", "tensorboard"),
    "generate": ("trimesh", "scikit-image", "h5py", "joblib", "webdataset", "opencv-python-headless",
                 "fast-simplification", "matplotlib", "tqdm"),
    "fuse": ("scikit-image", "h5py", "opencv-python-headless", "fast-simplification", "matplotlib"),
    "gl": ("pyrender", "PyOpenGL"),
    "cluster": ("distributed", "ray"),
}

# Box of the probe, metres: its half sizes, and its faces with windings as mixed as real meshes have them.
_HALF_SIZES = np.array([0.5, 0.3, 0.7])
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * _HALF_SIZES
_FACES = np.array([
    (0, 1, 3), (0, 3, 2), (4, 5, 7), (4, 6, 7), (0, 1, 5), (0, 5, 4),
    (2, 3, 7), (2, 6, 7), (0, 2, 6), (0, 6, 4), (1, 3, 7), (1, 7, 5),
])  # fmt: skip


class Status(StrEnum):
    """How a check went. A warning is something that one can do without, a note nothing to worry about."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    FAILURE = "failure"


@dataclass(frozen=True)
class Check:
    """One line of the report: what was looked at, how it went, what was found, and how to fix it."""

    name: str
    status: Status
    found: str
    fix: str | None = None


def run_doctor(console: Console) -> int:
    """Print the report; the exit status is 1 if anything failed that the package cannot do without."""
    with console.status("looking around and trying each render backend"):
        checks = diagnose()
    colours = {Status.OK: "green", Status.NOTE: "dim", Status.WARNING: "yellow", Status.FAILURE: "bold red"}
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    for check in checks:
        colour = colours[check.status]
        table.add_row(f"[{colour}]{check.status}[/]", check.name, escape(check.found))
    console.print(table)
    fixable = [check for check in checks if check.fix]
    if fixable:
        console.print("\nTo fix:")
    for check in fixable:
        console.print(f"  {check.name}:  [bold]{escape(check.fix or '')}[/]", soft_wrap=True)
    return int(any(check.status is Status.FAILURE for check in checks))


def diagnose() -> list[Check]:
    """Every check, in the order in which a person would want to read them."""
    return [
        Check("Python", Status.OK, f"{platform.python_version()}, {platform.platform()}"),
        *(_libraries(extra, names) for extra, names in _LIBRARIES.items()),
        _machine(),
        *(_disk(path) for path in (Path.cwd(), Path(tempfile.gettempdir()))),
        _raster(),
        _egl(),
        _osmesa(),
    ]


def _libraries(extra: str, names: tuple[str, ...]) -> Check:
    found, missing = [], []
    for name in names:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    text = ", ".join(found) + (f"; not installed: {', '.join(missing)}" if missing else "")
    if not missing:
        return Check(f"libraries: {extra}", Status.OK, text)
    # Nobody needs both of the clusters, and most need none.
    status = {"core": Status.FAILURE, "cluster": Status.NOTE}.get(extra, Status.WARNING)
    fix = None if extra == "cluster" else f"pip install '{'ocnf' if extra == 'core' else f'ocnf[{extra}]'}'"
    return Check(f"libraries: {extra}", status, text.removeprefix("; "), fix)


def _machine() -> Check:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    total = _memory("MemTotal")
    free = _memory("MemAvailable")
    text = f"{cores} cores"
    if total is not None and free is not None:
        text += f", {free / 2**30:.1f} of {total / 2**30:.1f} GiB of memory free"
        if free < cores * _MEMORY_PER_CORE:
            jobs = max(1, free // _MEMORY_PER_CORE)
            return Check("machine", Status.WARNING, text, f"use --jobs {jobs}: a worker takes up to 800 MB")
    return Check("machine", Status.OK, text)


def _memory(entry: str) -> int | None:
    """Bytes of an entry of /proc/meminfo, None on systems that have none."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    values = dict(line.split(":", 1) for line in lines)
    return int(values[entry].split()[0]) * 1024 if entry in values else None


def _disk(path: Path) -> Check:
    usage = shutil.disk_usage(path)
    text = f"{path}: {usage.free / 2**30:.1f} of {usage.total / 2**30:.1f} GiB free"
    if usage.free < _DISK:
        return Check("disk", Status.WARNING, text, "choose an --out with more room, some MB a sample")
    return Check("disk", Status.OK, text)


def _raster() -> Check:
    report = _try_in_child("raster")
    if "problem" in report:
        return Check("render: raster", Status.FAILURE, report["problem"],
                     "pip install --force-reinstall numba llvmlite")
    return _judged("render: raster", report, Status.FAILURE, "please report this, with the text above")


def _egl() -> Check:
    name = "render: pyrender on EGL"
    if ctypes.util.find_library("EGL") is None:
        return Check(name, Status.WARNING, "libEGL is not installed", LIBRARIES)
    report = _try_in_child("pyrender", PYOPENGL_PLATFORM="egl")
    if "problem" in report:
        fix = MISSING if "not installed" in report["problem"] else LIBRARIES
        return Check(name, Status.WARNING, report["problem"], fix)
    return _judged(name, report, Status.WARNING, "use the backend raster")


def _osmesa() -> Check:
    name = "render: pyrender on OSMesa"
    if ctypes.util.find_library("OSMesa") is None:
        return Check(name, Status.NOTE, f"libOSMesa is not installed; of use only without EGL: {OSMESA}")
    report = _try_in_child("pyrender", PYOPENGL_PLATFORM="osmesa")
    if "problem" in report:
        # pyrender pins a PyOpenGL that knows no OSMesa contexts, so no set of requirements can ask for both.
        fix = MISSING if "not installed" in report["problem"] else OSMESA
        return Check(name, Status.NOTE, report["problem"], fix)
    return _judged(name, report, Status.WARNING, "use the backend raster")


def _judged(name: str, report: dict[str, Any], if_wrong: Status, fix: str) -> Check:
    """A drawing that came back: is it right?"""
    p99, wrong, pixels = report["p99"], report["wrong"], report["pixels"]
    text = (f"99 % within {p99 * 1e3:.4f} mm, {wrong} of {pixels} pixels wrong, "
            f"{report['ms']:.1f} ms a view, {report['by']}")
    right = p99 < 1e-5 and wrong <= pixels / 2000
    return Check(name, Status.OK, text) if right else Check(name, if_wrong, text, fix)


def _try_in_child(backend: str, **environment: str) -> dict[str, Any]:
    """The probe's report, or {"problem": why there is none}."""
    command = [sys.executable, "-m", "ocnf_data.doctor", backend]
    try:
        done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True,
                              timeout=_TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return {"problem": f"gave no picture within {_TIMEOUT:.0f} s"}
    if done.returncode < 0:
        return {"problem": f"crashed with {signal.Signals(-done.returncode).name}"}
    if done.returncode:
        last_line = (done.stderr.strip() or "no message").splitlines()[-1]
        return {"problem": f"failed: {last_line}"}
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return report


def probe(backend: str) -> dict[str, Any]:
    """Draw the box from 8 sides and compare with its formula.

    Returns:
        p99: metres, the error that 99 % of the pixels keep within; wrong: pixels hit or missed wrongly or off
        by more than a millimetre, of `pixels`; ms: milliseconds a view; by: what did the drawing. Or only
        {"problem": a sentence}.
    """
    K, size = intrinsics(220.0, 180.0, 141.3, 130.6), (240, 321)
    R, T = look_from(fibonacci(8), 2.5)
    try:
        render_depth(_CORNERS, _FACES, K, R, T, size, backend)  # type: ignore[arg-type]
        start = time.perf_counter()
        depth = render_depth(_CORNERS, _FACES, K, R, T, size, backend)  # type: ignore[arg-type]
        seconds = time.perf_counter() - start
    except OcnfError as error:
        return {"problem": str(error)}
    expected = _box_depth(K, R, T, size)
    hit = np.isfinite(depth) & np.isfinite(expected)
    error_there = np.abs(depth[hit] - expected[hit])
    missed = np.isfinite(depth) != np.isfinite(expected)
    return {
        "p99": float(np.percentile(error_there, 99)) if hit.any() else float("inf"),
        "wrong": int(missed.sum() + (error_there > 1e-3).sum()),
        "pixels": int(np.isfinite(expected).sum()),
        "ms": 1e3 * seconds / len(R),
        "by": _drawn_by(backend),
    }


def _box_depth(
    K: F64, R: F64, T: F64, size: tuple[int, int]
) -> F64:
    """Depth (V, H, W) of the box: the ray enters it where it is inside all three pairs of planes."""
    v, u = np.mgrid[: size[0], : size[1]]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(size)], axis=-1)
    depth = np.empty((len(R), *size))
    for i in range(len(R)):
        origin, directions = -R[i].T @ T[i], rays @ R[i]
        with np.errstate(divide="ignore"):
            planes = np.stack([(sign * _HALF_SIZES - origin) / directions for sign in (-1, 1)])
        enter, leave = planes.min(axis=0).max(axis=-1), planes.max(axis=0).min(axis=-1)
        depth[i] = np.where(enter <= leave, enter, np.inf)
    return depth


def _drawn_by(backend: str) -> str:
    if backend == "raster":
        import numba

        if numba.get_num_threads() == 1:
            return "numba, 1 thread"
        return f"numba, {numba.get_num_threads()} threads ({numba.threading_layer()})"
    from OpenGL.GL import GL_RENDERER, glGetString

    return str(glGetString(GL_RENDERER).decode())


if __name__ == "__main__":
    print(json.dumps(probe(sys.argv[1])))
