"""Times and peak memory of fusion, beside a dense numba loop on the same threads.

    python tools/bench/fusion.py [MESH] [--threads 2] [--dense-resolution 256] [--no-memory]

80 views, 640x480, of the paper's rig; the 4-view variant has 2 % noise. Without MESH a procedural chair.
Peak memory is that of a child process above what it holds once the package is imported, its kernels are
loaded and the depth maps are read; the pyramid counts.

What made the difference, seconds for 80 views of a chair into the 256^3 TSDF on one thread, the pyramid
(0.03) not counted; the dense loop takes 10:

    0.56    cubes of 16, 8 and 4 voxels tested against the pyramid (measured with the last line's code)
    0.28    the SILHOUETTE class: a cube in an object's shadow that some other view sees to be free is
            settled. 33 M voxel x views are left to evaluate of 1.34 G; the 2.2 M tests take 0.22
    0.27    division without Python's check for zero, so that the projection can be vectorised
    0.18    the eight parts of a cube tested at once, their geometry as vector code

Evaluation, in float64, is about a quarter of what is left, so float32 with a guard near ties was not tried.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numba
import numpy as np
from dense_fusion import dense_tsdf

from ocnf_data.encodings import Encoding
from ocnf_data.fusion import DepthPyramid, fuse, fuse_histogram, fuse_tsdf
from ocnf_data.meshes import normalise, read_mesh
from ocnf_data.render import render_depth
from ocnf_data.shapes import make_shape
from ocnf_data.views.cameras import Views
from ocnf_data.views.noise import add_noise, view_noise
from ocnf_data.views.rigs import intrinsics, look_from, published80, view_subset

Result = TypeVar("Result")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="?", type=Path)
    parser.add_argument("--threads", type=int, default=min(2, numba.get_num_threads()))
    parser.add_argument("--dense-resolution", type=int, default=256)
    parser.add_argument("--no-memory", action="store_true")
    parser.add_argument("--peak-of", type=Encoding, help=argparse.SUPPRESS)  # what the child process is asked
    arguments = parser.parse_args()
    if arguments.peak_of:
        print(_peak(arguments.mesh, arguments.peak_of))
        return

    clean = _views(arguments.mesh)
    noisy = _four_noisy(clean)
    fuse_tsdf(noisy, 8)  # load the kernels
    dense_tsdf(noisy, 8)
    numba.set_num_threads(arguments.threads)
    _against_dense(clean, arguments.dense_resolution)
    _one_sample(clean, noisy)
    if not arguments.no_memory:
        _memory({Encoding.TSDF: clean, Encoding.HISTOGRAM: noisy})


def _against_dense(clean: Views, resolution: int) -> None:
    n_threads = numba.get_num_threads()
    dense_s, volume = _timed(lambda: dense_tsdf(clean, resolution), repeat=1)
    pyramid_s, pyramid = _timed(lambda: DepthPyramid(clean))
    fused_s, octree = _timed(lambda: fuse_tsdf(pyramid, resolution))
    different = int((np.abs(octree.to_dense()[0] - volume) > 3e-6).sum())
    total = pyramid_s + fused_s
    print(f"80 views into the {resolution}^3 TSDF, {n_threads} threads")
    print(f"  dense numba loop     {dense_s:8.3f} s")
    print(f"  octree               {total:8.3f} s  (pyramid {pyramid_s:.3f}, fusion {fused_s:.3f})"
          f"  {dense_s / total:.0f}x")
    print(f"  leaves {octree.n_leaves} ({octree.n_leaves / volume.size:.2%}); voxels that differ: {different}"
          f" of {volume.size}\n")


def _one_sample(clean: Views, noisy: Views) -> None:
    """What a training sample costs one worker: TSDF of 80 views, histogram of 4, at three resolutions."""
    n_threads = numba.get_num_threads()
    numba.set_num_threads(1)
    rows = []
    for name, views, function in (("TSDF, 80 views", clean, fuse_tsdf),
                                  ("histogram, 4 noisy views", noisy, fuse_histogram)):
        pyramid_s, pyramid = _timed(lambda views=views: DepthPyramid(views))  # type: ignore[misc]
        rows.append((f"pyramid of {len(views)}", pyramid_s, ""))
        for resolution in (64, 128, 256):
            seconds, octree = _timed(lambda f=function, p=pyramid, r=resolution: f(p, r))  # type: ignore[misc]
            share = octree.n_leaves / resolution**3
            rows.append((f"{name}, {resolution}^3", seconds, f"{octree.n_leaves:8d} leaves ({share:.1%})"))
    print("one training sample, 1 thread")
    for label, seconds, note in rows:
        print(f"  {label:32s} {seconds:8.4f} s  {note}")
    print(f"  {'together':32s} {sum(row[1] for row in rows):8.4f} s\n")
    numba.set_num_threads(n_threads)


def _memory(cases: dict[Encoding, Views]) -> None:
    print("peak memory at 512^3")
    for encoding, views in cases.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "views.npz"
            np.savez(path, depth=views.depth, K=views.K, R=views.R, T=views.T)
            command = [sys.executable, __file__, str(path), "--peak-of", encoding]
            answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        print(f"  {encoding} of {len(views)} views: {answer.strip()}")


def _peak(path: Path, encoding: Encoding) -> str:
    with np.load(path) as arrays:
        views = Views(**{name: arrays[name] for name in ("depth", "K", "R", "T")})
    fuse(views.subset([0]), encoding, 8)
    base, peak, done = _resident(), [0], threading.Event()

    def watch() -> None:
        while not done.wait(0.002):
            peak[0] = max(peak[0], _resident())

    watcher = threading.Thread(target=watch)
    watcher.start()
    seconds, octree = _timed(lambda: fuse(views, encoding, 512), repeat=1)
    done.set()
    watcher.join()
    return f"{(peak[0] - base) / 1e6:.0f} MB, {seconds:.2f} s, {octree!r}"


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _views(mesh_path: Path | None) -> Views:
    mesh = read_mesh(mesh_path) if mesh_path else make_shape("chair", 0, 0, "test")
    vertices, _ = normalise(mesh)
    R, T = look_from(published80(), 3.0)
    K = intrinsics(351, 351, 320, 240)
    return Views(render_depth(vertices, mesh.faces, K, R, T, size=(480, 640)), K, R, T)


def _four_noisy(views: Views) -> Views:
    chosen = view_subset(len(views), 4)
    depth = [add_noise(views.depth[i], 0.02, view_noise(0, "bench", int(i), views.size)) for i in chosen]
    return views.subset(chosen).with_depth(np.stack(depth))


def _timed(function: Callable[[], Result], repeat: int = 3) -> tuple[float, Result]:
    """Best of `repeat` runs in seconds, and the last result."""
    best = float("inf")
    for _ in range(repeat):
        start = time.perf_counter()
        result = function()
        best = min(best, time.perf_counter() - start)
    return best, result


if __name__ == "__main__":
    main()
