"""Surfaces of a few frames of a scan, by each method, against plain fusion of its other frames.

    python tools/bench/scans.py SCAN --frames 10 20 --apart 2

At 256^3, in the largest object of the scan. The frames of the input are spread evenly, and the reference
holds only those that are more than `--apart` frames away from each of them; where that would leave less than
30 % of the scan, the input takes several consecutive frames at fewer places.

Accuracy is the mean distance from the surface to the reference, over the part of it that the reference's
frames looked at and that is not behind what they measured; completeness that from the reference to the
surface, over the part that the input's frames measured; F-score the harmonic mean of the shares within one
voxel. "thin" is the share, within a voxel, of what is thinner than 3 voxels in the reference, "flat" the
standard deviation from flat on the three largest planes.

Plain fusion of all frames also holds what a single frame mistook, which only plain fusion of other frames is
likely to repeat. So there are two tables: by all of the reference, and by the part of it that at least three
of its frames have measured to within a voxel, with accuracy where as many looked.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from numba import set_num_threads
from reconstructions import (
    RESOLUTION,
    SAMPLES,
    Comparison,
    Truth,
    compare,
    largest_planes,
    methods,
    surface_of,
    table_of,
)
from rich.console import Console
from rich.progress import track

from ocnf_data.arrays import F64, Bool
from ocnf_data.fusion import DepthPyramid, default_truncation
from ocnf_data.views.cameras import Views
from ocnf_data.views.rigs import view_subset
from ocnf_data.views.scans import Scan, read_scan
from ocnf_model.checkpoint import SHIPPED
from ocnf_model.measures.surface import sample_triangles
from ocnf_model.measures.thickness import local_thickness
from ocnf_model.scan.components import keep_vertices
from ocnf_model.scan.fuse import choose_region, reconstruct
from ocnf_model.scan.fusers import Baseline
from ocnf_model.scan.region import Region, observed

_LEAST = 0.3  # share of a scan's frames that the reference has at least
_THIN = 3.0  # voxels
_AGREE = 3  # frames


def split_frames(n: int, k: int, apart: int) -> tuple[list[int], list[int]]:
    """The numbers of k of n frames for the input, and those more than `apart` frames away from all of them.

    The k frames stand in groups of equal length, as many and as evenly spread as leaves 30 % of the frames.

    >>> split_frames(12, 2, 1)
    ([0, 11], [2, 3, 4, 5, 6, 7, 8, 9])
    >>> split_frames(12, 4, 1)
    ([0, 1, 10, 11], [3, 4, 5, 6, 7, 8])
    """
    for groups in (g for g in range(k, 0, -1) if k % g == 0):
        length = k // groups
        chosen = sorted({int(first) + i for first in view_subset(n - length + 1, groups)
                         for i in range(length)})
        rest = [i for i in range(n) if min(abs(i - one) for one in chosen) > apart]
        if len(chosen) == k and len(rest) >= _LEAST * n:
            return chosen, rest
    raise SystemExit(f"{n} frames are too few for {k} and a reference that is {apart} away from them")


def part_of(scan: Scan, frames: list[int]) -> Scan:
    """Some frames of a scan, without colour."""
    return Scan(scan.views.subset(frames), tuple(scan.names[i] for i in frames))


def behind(points: F64, views: Views) -> Iterator[F64]:
    """For each view, metres (N,) that points (N, 3) lie behind what it measured there; NaN where nothing."""
    height, width = views.size
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        x, y, z = R @ points.T + T[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = np.floor(K[0, 0] * x / z + K[0, 2] + 0.5), np.floor(K[1, 1] * y / z + K[1, 2] + 0.5)
        inside = np.flatnonzero((z > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height))
        found = np.full(len(points), np.nan)
        measured = depth[v[inside].astype(int), u[inside].astype(int)]
        found[inside] = np.where(measured > 0, z[inside] - measured, np.nan)
        yield found


def looked_through(points: F64, views: Views, band: float, least: int) -> Bool:
    """Which of the points (N, 3) so many views measured something at or behind."""
    return np.asarray(sum((off <= band).astype(int) for off in behind(points, views)) >= least)


def agreed(points: F64, views: Views, voxel: float, least: int) -> Bool:
    """Which of the points (N, 3) so many views have measured to within a voxel."""
    return np.asarray(sum((np.abs(off) <= voxel).astype(int) for off in behind(points, views)) >= least)


def references_of(scan: Scan, seen: Views, region: Region) -> dict[str, Truth]:
    """Plain fusion of a scan, all of it and what three frames agree on, for surfaces of the views `seen`."""
    found = reconstruct(scan, DepthPyramid(scan.views), Baseline(RESOLUTION), region)
    voxel, band = region.size / RESOLUTION, default_truncation(RESOLUTION, region.size)
    truths = {}
    for name, least in (("all", 0), (f"what {_AGREE} frames agree on", _AGREE)):
        kept = agreed(found.vertices, scan.views, voxel, least)
        surface = surface_of(*keep_vertices(found.vertices, found.faces, kept))
        samples = sample_triangles(surface.triangles, SAMPLES)
        thickness = local_thickness(found.octree, samples.points - region.centre, samples.normals, 4 * voxel,
                                    region.size)
        asked = observed(samples.points, seen, band)
        truths[name] = Truth(surface, samples.points[asked], thickness[asked] < _THIN * voxel,
                             largest_planes(samples.points, voxel), voxel,
                             partial(looked_through, views=scan.views, band=band, least=max(least, 1)))
    return truths


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scan")
    parser.add_argument("--frames", nargs="+", type=int, default=[10, 20])
    parser.add_argument("--apart", type=int, default=2)
    parser.add_argument("--runs", nargs="*", help="networks, by the names or folders of their runs")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    set_num_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    everything = read_scan(arguments.scan)
    region = choose_region(everything, DepthPyramid(everything.views), None, room=False)
    chosen = methods(SHIPPED if arguments.runs is None else arguments.runs)
    tables: dict[str, dict[tuple[str, ...], list[Comparison]]] = {}
    for n in arguments.frames:
        seen, others = split_frames(len(everything.views), n, arguments.apart)
        scan = part_of(everything, seen)
        truths = references_of(part_of(everything, others), scan.views, region)
        name = f"{n}, reference {len(others)}"
        for method, make in track(chosen.items(), name, console=Console(stderr=True)):
            found = make(scan, region)
            for reference, truth in truths.items():
                tables.setdefault(reference, {})[name, method] = [compare(found, truth)]
    for reference, rows in tables.items():
        Console().print(table_of(f"{arguments.scan}, {len(everything.views)} frames, voxels of "
                                 f"{1000 * region.size / RESOLUTION:.2f} mm; reference: {reference}",
                                 ("frames", "method"), rows))


if __name__ == "__main__":
    main()
