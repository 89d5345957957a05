"""The octrees that the octree benchmarks measure: those of a sample, from a mesh or a shape."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from ocnf_data.encodings import Encoding
from ocnf_data.fusion import DepthPyramid, fuse, fuse_tsdf
from ocnf_data.meshes import normalise, read_mesh
from ocnf_data.octree import TARGET, GridOctree
from ocnf_data.render import render_depth
from ocnf_data.shapes import make_shape
from ocnf_data.views.cameras import Views
from ocnf_data.views.noise import add_noise, view_noise
from ocnf_data.views.rigs import intrinsics, look_from, published80, view_subset

Result = TypeVar("Result")


def sample_octrees(mesh: Path | str, resolutions: tuple[int, ...]) -> dict[tuple[str, int], GridOctree]:
    """(kind, resolution) -> octree: TSDF of 80 views as target; 4 views with 2 % noise in each encoding.

    `mesh` is a file, or the category of a procedural shape.
    """
    source = read_mesh(mesh) if Path(mesh).suffix else make_shape(str(mesh), 0, 0, "test")
    vertices, _ = normalise(source)
    K = intrinsics(351, 351, 320, 240)
    R, T = look_from(published80(), 3.0)
    clean = Views(render_depth(vertices, source.faces, K, R, T, (480, 640)), K, R, T)
    indices = view_subset(80, 4)
    seen = clean.subset(indices)
    noisy = [add_noise(depth, 0.02, view_noise(0, "bench", int(view), seen.size))
             for view, depth in zip(indices, seen.depth, strict=True)]
    truth, inputs = DepthPyramid(clean), DepthPyramid(seen.with_depth(np.stack(noisy)))
    octrees: dict[tuple[str, int], GridOctree] = {}
    for resolution in resolutions:
        octrees[TARGET, resolution] = fuse_tsdf(truth, resolution)
        for encoding in Encoding:
            octrees[str(encoding), resolution] = fuse(inputs, encoding, resolution)
    return octrees


def timed(call: Callable[[], Result], repeat: int = 5) -> tuple[float, Result]:
    """(milliseconds of the fastest call, its result); one call before the clock starts."""
    result = call()
    fastest = float("inf")
    for _ in range(repeat):
        start = time.perf_counter()
        result = call()
        fastest = min(fastest, time.perf_counter() - start)
    return 1e3 * fastest, result


def print_table(header: str, rows: list[list[str]]) -> None:
    """A Markdown table; the first column is text, the others numbers."""
    titles = header.split(" | ")
    widths = [max(len(row[i]) for row in [titles, *rows]) for i in range(len(titles))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    for row in [titles, rule, *rows]:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        cells[0] = row[0].ljust(widths[0])
        print(f"| {' | '.join(cells)} |")
    print(flush=True)
