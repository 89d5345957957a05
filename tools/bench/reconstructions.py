"""Surfaces by each method, and what they are held against: what `scans.py` and `rooms.py` share.

Every method goes through the code of `ocnf-model fuse`, at 256^3 in one cube. Open3D's ScalableTSDFVolume is
one more where `open3d` can be imported: voxels of the same size, a truncation of 5.12 voxels as in its own
tutorial, the same loose parts dropped. It is no part of this package, nor needed by it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from importlib.util import find_spec

import numpy as np
from rich.table import Table
from scipy.spatial import cKDTree

from ocnf_data.arrays import F64, I64, Bool
from ocnf_data.fusion import DepthPyramid
from ocnf_data.views.scans import Scan
from ocnf_model.checkpoint import SHIPPED, open_run
from ocnf_model.evaluation.methods import default_weight
from ocnf_model.measures.surface import Surface, sample_triangles
from ocnf_model.scan.components import LOOSE_VOXELS, drop_loose, keep_vertices
from ocnf_model.scan.fuse import reconstruct
from ocnf_model.scan.fusers import Baseline, Fuser, Learned
from ocnf_model.scan.region import Region

RESOLUTION = 256
SAMPLES = 60_000
_OPEN3D_TRUNCATION = 5.12  # voxels
_FLAT_FROM_EDGES = 4.0  # voxels between a flat place and anything that is not in its plane
_FLAT_BAND = 3.0  # voxels off the plane up to which a surface is taken for the plane's

Method = Callable[[Scan, Region], Surface]
"""The surface, metres, in a region of a scan."""


def methods(runs: Iterable[str] = SHIPPED) -> dict[str, Method]:
    """VolFus, TV-L1, Open3D where it is installed, and networks by the names of their runs."""
    fusers: dict[str, Fuser] = {"VolFus": Baseline(RESOLUTION),
                                "TV-L1": Baseline(RESOLUTION, default_weight(RESOLUTION))}
    found: dict[str, Method] = {name: partial(_fused, fuser) for name, fuser in fusers.items()}
    if find_spec("open3d") is not None:
        found["Open3D"] = _open3d
    return found | {name: partial(_fused, Learned.of(open_run(name), None)) for name in runs}


def _fused(fuser: Fuser, scan: Scan, region: Region) -> Surface:
    found = reconstruct(scan, DepthPyramid(scan.views), fuser, region)
    return surface_of(found.vertices, found.faces)


def _open3d(scan: Scan, region: Region) -> Surface:
    import open3d

    voxel = region.size / RESOLUTION
    volume = open3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=voxel, sdf_trunc=_OPEN3D_TRUNCATION * voxel,
        color_type=open3d.pipelines.integration.TSDFVolumeColorType.NoColor)
    views = scan.views.without_background()
    height, width = views.size
    blank = open3d.geometry.Image(np.zeros((height, width, 3), np.uint8))
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        image = open3d.geometry.Image(depth)
        pinhole = open3d.camera.PinholeCameraIntrinsic(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R, T
        volume.integrate(open3d.geometry.RGBDImage.create_from_color_and_depth(
            blank, image, depth_scale=1.0, depth_trunc=1e3, convert_rgb_to_intensity=False), pinhole, pose)
    mesh = volume.extract_triangle_mesh()
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles, dtype=np.int64)
    vertices, faces = keep_vertices(vertices, faces, region.holds(vertices))
    vertices, faces, _ = drop_loose(vertices, faces, LOOSE_VOXELS * voxel)
    return surface_of(vertices, faces)


def surface_of(vertices: F64, faces: I64) -> Surface:
    """The surface in metres, a part a triangle."""
    triangles = vertices[faces].astype(np.float32)  # (M, 3, 3)
    return Surface(triangles, np.arange(len(triangles) + 1), triangles.mean(axis=1))


@dataclass(frozen=True, eq=False)
class Plane:
    """A flat part of the true surface.

    Attributes:
        normal: (3,) of length 1.
        offset: metres; points p of the plane have normal p = offset.
        places: (N, 3) points of the flat part, all far from whatever else there is.
    """

    normal: F64
    offset: float
    places: F64


@dataclass(frozen=True, eq=False)
class Truth:
    """What surfaces are held against.

    Attributes:
        surface: whatever a reconstruction may rightly show: accuracy is the distance to it.
        asked: (N, 3) points that a reconstruction has to reach: completeness is the distance from them.
        thin: (N,) which of them belong to thin things.
        planes: flat parts.
        voxel: metres.
        knows: which of the points (N, 3) of a reconstruction can be held against it; None: all.
    """

    surface: Surface
    asked: F64
    thin: Bool
    planes: list[Plane]
    voxel: float
    knows: Callable[[F64], Bool] | None = None


@dataclass(frozen=True)
class Comparison:
    """A surface against the truth; millimetres, and shares within one voxel of 256^3.

    Attributes:
        accuracy: mean distance from the surface to the true one.
        completeness: mean distance from the true surface to it.
        f_score: harmonic mean of the shares of both within a voxel.
        thin: share of the thin part of the true surface within a voxel; NaN where there is none.
        flat: standard deviation from flat over the flat parts, each with a plane of its own fitted.
    """

    accuracy: float
    completeness: float
    f_score: float
    thin: float
    flat: float


def compare(found: Surface, truth: Truth) -> Comparison:
    """Hold a surface against the truth."""
    there = sample_triangles(found.triangles, SAMPLES)
    judged = there.points if truth.knows is None else there.points[truth.knows(there.points)]
    to_truth, to_found = truth.surface.nearest(judged)[0], found.nearest(truth.asked)[0]
    precision, recall = (to_truth <= truth.voxel).mean(), (to_found <= truth.voxel).mean()
    thin = (to_found[truth.thin] <= truth.voxel).mean() if truth.thin.any() else np.nan
    return Comparison(float(1000 * to_truth.mean()), float(1000 * to_found.mean()),
                      float(2 * precision * recall / max(precision + recall, 1e-9)), float(thin),
                      1000 * unevenness(there.points, truth.planes, truth.voxel))


def unevenness(points: F64, planes: Iterable[Plane], voxel: float) -> float:
    """Standard deviation, metres, of a surface's points (N, 3) from planes fitted where the truth is flat.

    A point belongs to a flat part that lies within 3 voxels along the normal and one across it. A plane is
    fitted to the points of each part, so that a surface may lie too far out everywhere and still be flat.
    """
    squares, count = 0.0, 0
    for plane in planes:
        off = points @ plane.normal - plane.offset
        near = points[np.abs(off) < _FLAT_BAND * voxel]
        if len(near) < 3:
            continue
        onto = near - np.outer(near @ plane.normal - plane.offset, plane.normal)
        apart, _ = cKDTree(plane.places).query(onto, distance_upper_bound=2 * voxel)
        on = near[np.isfinite(apart)]
        if len(on) >= 100:
            smallest = np.linalg.svd(on - on.mean(axis=0), compute_uv=False)[-1]
            squares, count = squares + float(smallest**2), count + len(on)
    return float(np.sqrt(squares / count)) if count else float("nan")


def flat_part(points: F64, on: Bool, normal: F64, offset: float, voxel: float) -> Plane:
    """The plane's part that is at least 4 voxels from all points (N, 3) of the true surface not `on` it."""
    places = points[on]
    if not on.all():
        apart, _ = cKDTree(points[~on]).query(places, distance_upper_bound=_FLAT_FROM_EDGES * voxel)
        places = places[np.isinf(apart)]
    return Plane(normal, offset, places)


def largest_planes(points: F64, voxel: float, n: int = 3, seed: int = 0) -> list[Plane]:
    """The largest planes of a surface's points (N, 3), one after the other, by RANSAC.

    Points within half a voxel are a plane's; one with less than 3 % of all points is left out.
    """
    random, left, found = np.random.default_rng(seed), np.ones(len(points), bool), []
    for _ in range(n):
        rest = points[left]
        best = np.zeros(len(rest), bool)
        for _ in range(1000):
            a, b, c = rest[random.choice(len(rest), 3, replace=False)]
            normal = np.cross(b - a, c - a)
            length = np.linalg.norm(normal)
            if length > 0:
                on = np.abs((rest - a) @ (normal / length)) < voxel / 2
                best = on if on.sum() > best.sum() else best
        if best.sum() < 0.03 * len(points):
            break
        middle = rest[best].mean(axis=0)
        normal = np.linalg.svd(rest[best] - middle, full_matrices=False)[2][-1]
        on = np.abs((points - middle) @ normal) < voxel
        found.append(flat_part(points, on, normal, float(middle @ normal), voxel))
        left &= ~on
    return found


def table_of(title: str, first: Iterable[str], rows: Mapping[tuple[str, ...], list[Comparison]]) -> Table:
    """Means of the comparisons of each row; `first` are the headings of what names a row, the method last.

    A row whose leading names differ from those before begins a section. The best figure of a section is bold.
    """
    table = Table(title=title)
    for heading in first:
        table.add_column(heading)
    headings = ("accuracy mm", "completeness mm", "F-score", "thin", "flat mm")
    for heading in headings:
        table.add_column(heading, justify="right")
    means = {names: [float(np.nanmean([getattr(one, field.name) for one in found]))
                     if not np.isnan([getattr(one, field.name) for one in found]).all() else float("nan")
                     for field in fields(Comparison)] for names, found in rows.items()}
    digits, signs = (2, 2, 3, 3, 2), (1, 1, -1, -1, 1)
    before: tuple[str, ...] | None = None
    for names, values in means.items():
        if before is not None and names[:-1] != before:
            table.add_section()
        before = names[:-1]
        section = [other for key, other in means.items() if key[:-1] == before]
        cells = []
        for i, value in enumerate(values):
            text = "" if np.isnan(value) else f"{value:.{digits[i]}f}"
            best = min(signs[i] * other[i] for other in section)
            cells.append(f"[bold]{text}[/bold]" if signs[i] * value == best else text)
        table.add_row(*names, *cells)
    return table
