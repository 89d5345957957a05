"""Milliseconds a view of each way to render depth, side by side on the same meshes, one thread each.

    python tools/bench/render.py [FOLDER | MESH ...] [--meshes 15] [--views 10]

Of the mesh files (default: those under $OCNF_DATA/meshes, else procedural shapes) with 2,000 to 40,000
faces, some are chosen evenly and drawn at 640x480 from the paper's rig. Every way runs in a child process
of its own, and one that is not installed is left out, with the reason. Reading the mesh and a first
rendering (compiling, opening a context) are not counted; handing the mesh over, and the ray caster's rays,
are. Errors are against `raster`, which the tests hold to ray casting.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Column, Table

from ocnf_data.arrays import F32, F64, I64
from ocnf_data.errors import OcnfError
from ocnf_data.meshes import normalise, read_mesh
from ocnf_data.render import render_depth
from ocnf_data.shapes import CATEGORIES, make_shape
from ocnf_data.views.rigs import intrinsics, look_from, published80, view_subset

K, SIZE = intrinsics(351.0, 351.0, 320.0, 240.0), (480, 640)
FACES = (2_000, 40_000)
REPEATS = 3
SUFFIXES = {".off", ".obj", ".ply", ".stl", ".glb"}
ONE_THREAD = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}
# Name in the table -> function that draws, environment.
WAYS: dict[str, tuple[str, dict[str, str]]] = {
    "raster": ("raster", {}),
    "pyrender, EGL": ("pyrender", {"PYOPENGL_PLATFORM": "egl"}),
    "pyrender, OSMesa": ("pyrender", {"PYOPENGL_PLATFORM": "osmesa"}),
    "embreex": ("embreex", {}),
}
BASE = "pyrender, EGL"


def main() -> None:
    """Choose the meshes, draw them in every way in a child each, print the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--meshes", type=int, default=15)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--child", choices=DRAW, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(DRAW[options.child], options.paths, options.views)))
        return
    with tempfile.TemporaryDirectory() as folder:
        if not options.paths and "OCNF_DATA" in os.environ:
            options.paths = [Path(os.environ["OCNF_DATA"], "meshes")]
        meshes = choose(options.paths or [write_shapes(Path(folder))], options.meshes)
        reports = {way: run_child(*WAYS[way], meshes, options.views) for way in WAYS}
    print_table(reports, len(meshes), options.views)


def write_shapes(folder: Path) -> Path:
    """Write two procedural shapes of each category as OFF files."""
    for category, index in product(CATEGORIES, range(2)):
        shape = make_shape(category, 0, index, "train")
        rows = [" ".join(map(str, vertex)) for vertex in shape.vertices.tolist()]
        rows += [f"3 {a} {b} {c}" for a, b, c in shape.faces.tolist()]
        header = f"OFF\n{len(shape.vertices)} {len(shape.faces)} 0\n"
        (folder / f"{category}-{index}.off").write_text(header + "\n".join(rows) + "\n")
    return folder


def choose(paths: Iterable[Path], n: int) -> list[Path]:
    """Up to n mesh files, spread evenly over those whose number of faces is in range."""
    files = [f for path in paths for f in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    files = [f for f in files if f.suffix.lower() in SUFFIXES]
    fitting = []
    for file in files[:: max(1, len(files) // (8 * n))]:
        try:
            n_faces = len(read_mesh(file).faces)
        except OcnfError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        if FACES[0] <= n_faces <= FACES[1]:
            fitting.append(file)
    if not fitting:
        raise SystemExit(f"no mesh of {FACES[0]} to {FACES[1]} faces among {len(files)} files")
    return [fitting[i] for i in view_subset(len(fitting), min(n, len(fitting)))]


def run_child(way: str, environment: dict[str, str], meshes: list[Path], views: int) -> dict[str, Any]:
    """The child's report, or {"problem": the last line it wrote}."""
    command = [sys.executable, __file__, "--child", way, "--views", str(views), *map(str, meshes)]
    done = subprocess.run(command, env=os.environ | ONE_THREAD | environment, capture_output=True, text=True,
                          timeout=1800, check=False)
    if done.returncode:
        return {"problem": (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[-1]}
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return report


def measure(draw: Callable[..., F32], meshes: list[Path], n_views: int) -> dict[str, list[float]]:
    """Faces, ms a view (the best), mm that 99 % keep within, pixels a view off by over 1 mm, by mesh."""
    R, T = look_from(published80()[view_subset(80, n_views)], 3.0)
    report: dict[str, list[float]] = {"faces": [], "ms": [], "p99": [], "wrong": []}
    for path in meshes:
        mesh = read_mesh(path)
        vertices, _ = normalise(mesh)
        depth = draw(vertices, mesh.faces, R, T)
        seconds = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            draw(vertices, mesh.faces, R, T)
            seconds.append(time.perf_counter() - start)
        expected = render_depth(vertices, mesh.faces, K, R, T, SIZE)
        both = np.isfinite(depth) & np.isfinite(expected)
        gap = np.abs(depth[both] - expected[both])
        wrong = (np.isfinite(depth) != np.isfinite(expected)).sum() + (gap > 1e-3).sum()
        report["faces"].append(len(mesh.faces))
        report["ms"].append(1e3 * min(seconds) / n_views)
        report["p99"].append(1e3 * float(np.percentile(gap, 99)))
        report["wrong"].append(float(wrong) / n_views)
    return report


def draw_raster(vertices: F64, faces: I64, R: F64, T: F64) -> F32:
    """The z-buffer of this project."""
    return render_depth(vertices, faces, K, R, T, SIZE)


def draw_pyrender(vertices: F64, faces: I64, R: F64, T: F64) -> F32:
    """OpenGL, with the flags that give right depth."""
    return render_depth(vertices, faces, K, R, T, SIZE, backend="pyrender")


def draw_embreex(vertices: F64, faces: I64, R: F64, T: F64) -> F32:
    """Intel's ray caster."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, vertices[faces].astype(np.float32))
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(SIZE)], axis=-1).reshape(-1, 3)
    depth = np.empty((len(R), *SIZE), dtype=np.float32)
    for i in range(len(R)):
        directions = (rays @ R[i]).astype(np.float32)
        origins = np.broadcast_to((-R[i].T @ T[i]).astype(np.float32), directions.shape).copy()
        hits = scene.run(origins, directions, output=True)
        depth[i] = np.where(hits["primID"] >= 0, hits["tfar"], np.inf).reshape(SIZE)
    return depth


DRAW = {"raster": draw_raster, "pyrender": draw_pyrender, "embreex": draw_embreex}


def print_table(reports: dict[str, dict[str, Any]], n_meshes: int, n_views: int) -> None:
    """One row a way; speed is relative to BASE, the median over the meshes of each mesh's ratio."""
    faces = reports["raster"]["faces"]
    console = Console(width=110)
    console.print(f"{n_meshes} meshes of {min(faces):,} to {max(faces):,} faces, median "
                  f"{np.median(faces):,.0f}; {n_views} views of 640x480; one thread")
    table = Table("", *(Column(head, justify="right") for head in (
        "ms a view, median", "min .. max", "speed", "99 % within, mm", "pixels a view off")))
    base = reports[BASE].get("ms")
    for way, report in reports.items():
        if "problem" in report:
            continue
        ms = np.array(report["ms"])
        ratio = f"{np.median(np.array(base) / ms):.1f}x" if base else ""
        table.add_row(way, f"{np.median(ms):.2f}", f"{ms.min():.2f} .. {ms.max():.2f}", ratio,
                      f"{max(report['p99']):.4f}", f"{np.mean(report['wrong']):.1f}")
    console.print(table)
    for way, report in reports.items():
        if "problem" in report:
            console.print(f"{way}: left out: {report['problem']}")


if __name__ == "__main__":
    main()
