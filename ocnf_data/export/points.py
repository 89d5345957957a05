"""Point samples of a TSDF: on the surface, with occupancies, with signed distances.

The surface is that of marching cubes, the zero set of the TSDF interpolated linearly between voxel centres;
occupancies and distances come from the same interpolation, so the three agree. Beyond the cube is free space.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from ocnf_data.arrays import F32, F64
from ocnf_data.errors import OcnfError
from ocnf_data.export.dense import npz_bytes
from ocnf_data.export.sample import ExportSample
from ocnf_data.export.settings import Coordinates
from ocnf_data.octree import GridOctree
from ocnf_data.octree.triangles import cell_triangles

_PADDING = 0.1  # of Occupancy Networks: points are drawn in a box this much longer than the unit cube
# Of DeepSDF's sampling: 47 of 50 points lie near the surface, half of them off by either deviation, in units
# of the sphere; the others are uniform in the cube around it.
_NEAR_SHARE = 47 / 50
_DEVIATIONS = (0.005 ** 0.5, 0.0005 ** 0.5)


class SurfaceSamples(NamedTuple):
    """Points on a surface.

    Attributes:
        points: (N, 3) float64, x y z in metres.
        normals: (N, 3) float64 of length 1, outwards.
    """

    points: F64
    normals: F64


def surface_points(tsdf: GridOctree, n: int, random: np.random.Generator,
                   extent: float = 3.0) -> SurfaceSamples:
    """Points spread evenly, by area, over the surface of a TSDF octree, with the normals of its triangles.

    Args:
        tsdf: 1 channel, TSDF / tau.
        n: number of points.
        random: random generator that the points are drawn with.
        extent: side of the cube in metres; the origin is its centre.

    Raises:
        OcnfError: code `empty` where nothing is inside; several channels.
    """
    triangles = cell_triangles(tsdf, extent).triangles.astype(np.float64)
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normals = np.cross(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    area = np.cumsum(doubled)
    if not len(area) or area[-1] <= 0:
        raise OcnfError("the ground truth has no surface", code="empty", where="export",
                        fix="a finer resolution keeps thinner parts")
    chosen = np.searchsorted(area, random.random(n) * area[-1], side="right")
    # Uniform in the triangle: the square root makes up for its narrowing towards a (Osada et al. 2002).
    root, along = np.sqrt(random.random((n, 1))), random.random((n, 1))
    points = a[chosen] * (1 - root) + b[chosen] * root * (1 - along) + c[chosen] * root * along
    return SurfaceSamples(points, normals[chosen] / doubled[chosen, None])


def tsdf_at(tsdf: GridOctree, points: F64, extent: float = 3.0) -> F32:
    """TSDF / tau at points (N, 3) x y z in metres, linear between voxel centres; 1 beyond the cube: (N,).

    Raises:
        OcnfError: several channels: a histogram, or TDF and occupancy, whose sign lies in the second; or no
            points of that shape.
    """
    points = np.asarray(points, np.float64)
    if tsdf.data.shape[1] != 1:
        raise OcnfError("not a TSDF", where="export", field="channels", found=tsdf.data.shape[1], expected=1)
    if points.ndim != 2 or points.shape[1] != 3:
        raise OcnfError("not points", where="export", field="points", found=points.shape, expected="(N, 3)")
    size = extent / max(tsdf.shape)
    padded = np.pad(tsdf.to_dense()[0], 1, constant_values=1.0)
    index = points / size + np.array(tsdf.shape[::-1]) / 2 + 0.5  # voxel 0 of `padded` lies half outside
    found: F32 = map_coordinates(padded, index.T[::-1], order=1, mode="nearest", prefilter=False)
    return found


def occupancy_points(tsdf: GridOctree, n: int, random: np.random.Generator,
                     extent: float = 3.0) -> tuple[F64, np.ndarray]:
    """Points uniform in a box 1.1 times as long as the cube, and whether each is inside.

    Returns:
        points (N, 3), x y z in metres, and (N,) bool: TSDF < 0 there.
    """
    points = (random.random((n, 3)) - 0.5) * (extent * (1 + _PADDING))
    return points, tsdf_at(tsdf, points, extent) < 0


def sdf_samples(tsdf: GridOctree, n: int, random: np.random.Generator, extent: float = 3.0,
                truncation: float = 1.0) -> tuple[F64, F64]:
    """Points with signed distances, most of them near the surface, spread as DeepSDF's own preparation does.

    47 of 50 points are surface points moved by normal noise, of a standard deviation of 0.0707 or 0.0224
    times the surface's radius around the origin; the others are uniform in the cube around that sphere.

    Args:
        tsdf: 1 channel, TSDF / tau.
        n: number of points.
        random: random generator that the points are drawn with.
        extent: side of the cube in metres.
        truncation: tau in metres.

    Returns:
        pos (P, 4) and neg (M, 4) with P + M = n: x y z and the distance in metres, at most `truncation` from
        0; `pos` are those of 0 and more.

    Raises:
        OcnfError: code `empty` where no point came to lie inside.
    """
    near = surface_points(tsdf, int(n * _NEAR_SHARE), random, extent).points
    radius = surface_radius(tsdf, extent)
    deviation = np.resize(_DEVIATIONS, len(near))[:, None] * radius
    far = (random.random((n - len(near), 3)) * 2 - 1) * radius
    points = np.concatenate([near + deviation * random.standard_normal(near.shape), far])
    distance = tsdf_at(tsdf, points, extent).astype(np.float64) * truncation
    rows = np.concatenate([points, distance[:, None]], axis=1)
    inside = distance < 0
    if not inside.any():
        raise OcnfError("no point came to lie inside the surface", code="empty", where="export",
                        field="points", found=n, fix="raise the number of points or the resolution")
    return rows[~inside], rows[inside]


def surface_radius(tsdf: GridOctree, extent: float = 3.0) -> float:
    """The largest distance of the surface from the cube's centre, metres; 0 where there is no surface."""
    triangles = cell_triangles(tsdf, extent).triangles
    return float(np.sqrt((triangles ** 2).sum(axis=-1).max(initial=0.0)))


def points_files(sample: ExportSample) -> dict[str, bytes]:
    """The three files of a sample: `pointcloud.npz`, `points.npz`, and DeepSDF's samples."""
    truth, n, extent = sample.truth(), sample.settings.points, sample.extent
    radius = surface_radius(truth, extent)
    surface = surface_points(truth, n, sample.random("surface"), extent)
    where, inside = occupancy_points(truth, n, sample.random("occupancy"), extent)
    pos, neg = sdf_samples(truth, n, sample.random("distance"), extent, sample.truncation)
    cube = sample.frame(Coordinates.UNIT_CUBE, lambda: radius)
    ball = sample.frame(Coordinates.UNIT_SPHERE, lambda: radius)
    folder = f"occupancy_networks/{sample.category}/{sample.key}"
    return {
        f"{folder}/pointcloud.npz": npz_bytes({
            "points": (surface.points * cube.factor).astype(np.float32),
            "normals": surface.normals.astype(np.float32),
            "loc": cube.loc, "scale": np.array(cube.scale)}),
        f"{folder}/points.npz": npz_bytes({
            "points": (where * cube.factor).astype(np.float32), "occupancies": np.packbits(inside),
            "loc": cube.loc, "scale": np.array(cube.scale)}),
        f"deepsdf/SdfSamples/ocnf/{sample.category}/{sample.key}.npz": npz_bytes({
            "pos": (pos * ball.factor).astype(np.float32), "neg": (neg * ball.factor).astype(np.float32),
            "loc": ball.loc, "scale": np.array(ball.scale),
            "truncation": np.array(sample.truncation * ball.factor)}),
    }
