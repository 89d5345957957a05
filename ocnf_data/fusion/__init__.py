"""Fusion of posed depth views into octrees of voxels, in the four encodings of the paper (section 3.1).

Depth maps go straight into `GridOctree`, without a dense volume: cubes of voxels are classified against a
min-max pyramid of each depth map, and only where a view is not settled so are voxels evaluated. The result is
the one of SEMANTICS 2, voxel by voxel; where u + 0.5 or v + 0.5 of a projection lies within about 1e-9 of an
integer, or a distance within rounding of a threshold, either neighbour may be taken. Values are divided by
tau, so they lie in [-1, 1]; free and unseen space are exact constants.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from ocnf_data.arrays import F32, as_numbers
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import accumulate
from ocnf_data.fusion.bundles import Rule, Scene
from ocnf_data.fusion.projection import Grid, cell_offsets, grid_cameras
from ocnf_data.fusion.pyramid import DepthPyramid
from ocnf_data.fusion.threads import map_in_threads
from ocnf_data.fusion.traverse import ROOT, fuse_row, place_row
from ocnf_data.octree.grid import MAX_RESOLUTION, GridOctree
from ocnf_data.views.cameras import Views

__all__ = ["DepthPyramid", "default_truncation", "fuse", "fuse_histogram", "fuse_occupancy",
           "fuse_tdf_occupancy", "fuse_tsdf"]

Resolution = int | tuple[int, int, int]
Centre = tuple[float, float, float]

_TRUNCATION_VOXELS = 0.025 * 256 / 3  # the paper's 25 mm at 256^3 in the 3 m cube
_SPLIT_TOLERANCE = 1e-6  # of the encoding's full range


def default_truncation(resolution: Resolution, extent: float = 3.0) -> float:
    """The paper's tau in metres: 2.1333 voxels."""
    return _TRUNCATION_VOXELS * extent / max(_shape(resolution))


def fuse_tsdf(views: Views | DepthPyramid, resolution: Resolution, extent: float = 3.0,
              truncation: float | None = None, *, centre: Centre = (0.0, 0.0, 0.0)) -> GridOctree:
    """TSDF / tau, 1 channel in [-1, 1]: the mean of min(dist, tau) over the views with dist >= -tau.

    `dist` is measured depth - depth of the voxel, positive in front of the surface. Free space is exactly 1,
    a voxel no view counted exactly -1.

    Args:
        views: the depth maps, or their pyramid where several fusions share it.
        resolution: voxels along each axis of the cube, a multiple of 8; or (D, H, W), whose longest then
            measures `extent`.
        extent: edge length of the cube in metres.
        truncation: tau in metres; None = 2.1333 voxels.
        centre: world position (x, y, z) of the cube's centre in metres.

    Raises:
        OcnfError: a resolution that is no multiple of 8 or above 1024, a length that is not positive.
    """
    grid = _grid(resolution, extent, centre)
    tau = _length("truncation", truncation, default_truncation(resolution, extent))
    return _fuse(views, grid, Encoding.TSDF, accumulate.TSDF, -tau, tau, tau)


def fuse_tdf_occupancy(views: Views | DepthPyramid, resolution: Resolution, extent: float = 3.0,
                       truncation: float | None = None, *,
                       centre: Centre = (0.0, 0.0, 0.0)) -> GridOctree:
    """|TSDF| / tau and [TSDF < 0], 2 channels in [0, 1]. Arguments as for `fuse_tsdf`."""
    grid = _grid(resolution, extent, centre)
    tau = _length("truncation", truncation, default_truncation(resolution, extent))
    return _fuse(views, grid, Encoding.TDF_OCCUPANCY, accumulate.TDF_OCCUPANCY, -tau, tau, tau)


def fuse_histogram(views: Views | DepthPyramid, resolution: Resolution, extent: float = 3.0,
                   truncation: float | None = None, *, centre: Centre = (0.0, 0.0, 0.0)) -> GridOctree:
    """The share of the views that vote for each of 10 bins of dist, 10 channels that sum to 1.

    Bin centres are `linspace(-1.125, 1.125, 10) * tau`; a vote is split linearly between the two nearest.
    Views with dist >= -tau vote. Free space is the last bin, a voxel without votes the first. Arguments as
    for `fuse_tsdf`.
    """
    grid = _grid(resolution, extent, centre)
    tau = _length("truncation", truncation, default_truncation(resolution, extent))
    return _fuse(views, grid, Encoding.HISTOGRAM, accumulate.HISTOGRAM, -tau, 1.125 * tau, tau)


def fuse_occupancy(views: Views | DepthPyramid, resolution: Resolution, extent: float = 3.0,
                   truncation: float | None = None, *, threshold: float | None = None,
                   centre: Centre = (0.0, 0.0, 0.0)) -> GridOctree:
    """0 where some view sees more than `threshold` metres past the voxel, else 1; 1 channel.

    `threshold` None is one voxel. Occupancy has no truncation: that argument is there so that the four
    functions can be called alike. The others as for `fuse_tsdf`.
    """
    grid = _grid(resolution, extent, centre)
    _length("truncation", truncation, grid.voxel)
    seen = _length("threshold", threshold, grid.voxel)
    return _fuse(views, grid, Encoding.OCCUPANCY, accumulate.OCCUPANCY, seen, seen, seen)


class _Fusion(Protocol):
    def __call__(self, views: Views | DepthPyramid, resolution: Resolution, extent: float = ...,
                 truncation: float | None = ..., *, centre: Centre = ...) -> GridOctree: ...


_FUSIONS: dict[Encoding, _Fusion] = {
    Encoding.OCCUPANCY: fuse_occupancy,
    Encoding.TSDF: fuse_tsdf,
    Encoding.TDF_OCCUPANCY: fuse_tdf_occupancy,
    Encoding.HISTOGRAM: fuse_histogram,
}


def fuse(views: Views | DepthPyramid, encoding: Encoding, resolution: Resolution, extent: float = 3.0,
         truncation: float | None = None, *, centre: Centre = (0.0, 0.0, 0.0)) -> GridOctree:
    """Fuse into the given encoding; arguments as for `fuse_tsdf`.

    Raises:
        OcnfError: there is no such encoding, beside what `fuse_tsdf` raises.
    """
    if encoding not in tuple(Encoding):
        raise OcnfError("no such encoding", where="fusion", field="encoding", found=encoding,
                        expected=" or ".join(Encoding))
    return _FUSIONS[Encoding(encoding)](views, resolution, extent, truncation, centre=centre)


_FREE_AND_UNSEEN = {
    Encoding.OCCUPANCY: ([0], [1]),
    Encoding.TSDF: ([1], [-1]),
    Encoding.TDF_OCCUPANCY: ([1, 0], [1, 1]),
    Encoding.HISTOGRAM: ([0] * 9 + [1], [1] + [0] * 9),
}


def _fuse(views: Views | DepthPyramid, grid: Grid, encoding: Encoding, kind: int,
          hidden_below: float, free_from: float, truncation: float) -> GridOctree:
    """Fuse row by row of root cubes, then put the rows' leaves in the grid's order."""
    pyramid = views if isinstance(views, DepthPyramid) else DepthPyramid(views)
    views = pyramid.views
    cameras = grid_cameras(views, grid)
    images = views.depth.reshape(len(views), math.prod(views.size))
    scene = Scene(cameras, cell_offsets(cameras), images, pyramid.windows, pyramid.levels, views.size)
    rule = Rule(kind, hidden_below, free_from, truncation, _SPLIT_TOLERANCE * encoding.span)
    constants = np.array(_FREE_AND_UNSEEN[encoding], np.float32)
    gd, gh, gw = (n // 8 for n in grid.shape)
    trees = np.zeros((gd, gh, gw, 2), np.uint64)
    counts = np.empty((gd, gh, gw), np.int32)
    rows = [(z, y) for z in range(-(-grid.shape[0] // ROOT)) for y in range(-(-grid.shape[1] // ROOT))]

    def fuse_one(row: tuple[int, int]) -> F32:
        return fuse_row(scene, rule, constants, *row, trees, counts)

    leaves = map_in_threads(fuse_one, rows)
    prefix = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    data = np.empty((prefix[-1], encoding.channels), np.float32)
    while leaves:  # a row's leaves are dropped as soon as they are in place
        place_row(leaves.pop(), prefix, *rows.pop(), counts, data)
    return GridOctree.trusted(trees, data)


def _grid(resolution: Resolution, extent: float, centre: Centre) -> Grid:
    shape = _shape(resolution)
    extent = _length("extent", extent, math.nan)
    position = as_numbers(centre, "fusion", "centre", np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise OcnfError("not a position", where="fusion", field="centre", found=centre,
                        expected="(x, y, z) in metres")
    return Grid(shape, extent / max(shape), (float(position[0]), float(position[1]), float(position[2])))


def _shape(resolution: Resolution) -> tuple[int, int, int]:
    shape = tuple(resolution) if isinstance(resolution, tuple | list) else (resolution,) * 3
    whole = len(shape) == 3 and all(isinstance(n, int | np.integer) for n in shape)
    if not whole or any(n % 8 or not 8 <= n <= MAX_RESOLUTION for n in shape):
        raise OcnfError("resolution is not a multiple of 8 in range", where="fusion", field="resolution",
                        found=resolution, expected=f"8, 16, ... {MAX_RESOLUTION}")
    return int(shape[0]), int(shape[1]), int(shape[2])


def _length(field: str, metres: float | None, default: float) -> float:
    metres = default if metres is None else metres
    if not (isinstance(metres, float | int | np.number) and math.isfinite(metres) and metres > 0):
        raise OcnfError(f"{field} is not a length", where="fusion", field=field, found=metres,
                        expected="metres > 0")
    return float(metres)
