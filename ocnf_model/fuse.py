"""A depth scan to a mesh in the scan's coordinates: by the network, by VolFus or by TV-L1.

The network knows one cube. A region of the scan takes that cube's place: fusion measures everything in
voxels and in truncations, so that a cube of any side, anywhere, gives what the scan would, were it moved and
scaled into the cube of training, and the surface is in the scan's coordinates at once.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ocnf_data.cameras import Views
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid, default_truncation, fuse, fuse_histogram, fuse_tsdf
from ocnf_data.octree import GridOctree
from ocnf_data.sources.scans import Scan, read_scan
from ocnf_data.sources.writing import WRITERS
from ocnf_data.storage import Store
from ocnf_data.surface import octree_surface
from ocnf_model.baselines import tvl1
from ocnf_model.evaluation.devices import pick_device
from ocnf_model.evaluation.methods import COARSEST, Method, default_weight, parse_methods, run_levels
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.octree import OctreeBatch

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]

_PADDING = 0.05  # of the cube is free on both sides together, as around the meshes of training
_SEARCH_RESOLUTION = 128
_SEARCH_POINTS = 200_000
_OUTLIERS = 0.2  # per cent of the points at either end of an axis that do not stretch the search
_SEARCH_MARGIN = 0.1


@dataclass(frozen=True)
class Region:
    """A box of the scan, and the cube around it that is fused.

    Attributes:
        low, high: corners (x, y, z) of the box in metres.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    @classmethod
    def of_box(cls, box: Sequence[float]) -> Region:
        """The region of x0 y0 z0 x1 y1 z1, in metres.

        Raises:
            OcnfError: not six finite numbers, or a corner that is not below the other.
        """
        if len(box) != 6 or not np.isfinite(box).all() or not all(a < b for a, b in zip(box[:3], box[3:],
                                                                                         strict=True)):
            raise OcnfError("not a box", field="box", found=" ".join(map(str, box)),
                            expected="x0 y0 z0 x1 y1 z1 in metres, x0 < x1, y0 < y1, z0 < z1")
        x0, y0, z0, x1, y1, z1 = map(float, box)
        return cls((x0, y0, z0), (x1, y1, z1))

    @property
    def centre(self) -> tuple[float, float, float]:
        """Of box and cube."""
        x, y, z = ((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))
        return x, y, z

    @property
    def side(self) -> float:
        """Of the cube: the box's longest side takes 95 % of it, as in training."""
        return max(b - a for a, b in zip(self.low, self.high, strict=True)) / (1 - _PADDING)

    def holds(self, points: F64) -> npt.NDArray[np.bool_]:
        """Which of the points (N, 3) lie in the box."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1))


@dataclass(frozen=True)
class FusedMesh:
    """A surface in the scan's coordinates.

    Attributes:
        vertices: (N, 3) metres.
        faces: (M, 3), looking outwards.
        region: what was fused.
        resolution: voxels along the cube.
        seconds: fusion and reconstruction, without reading the scan and without marching cubes.
        notes: what the reader left out.
    """

    vertices: F64
    faces: I64
    region: Region
    resolution: int
    seconds: float
    notes: tuple[str, ...]


def run_fuse(run: str, scan: str, *, out: Path, box: tuple[float, ...] | None = None, method: str = "ours",
             resolution: int | None = None, device: str = "auto", weight: float | None = None,
             every: int = 1, keep_unseen: bool = False) -> FusedMesh:
    """Fuse a scan and write the mesh.

    Args:
        run: a training run, or `pretrained`; read only where the method is `ours`.
        scan: see `ocnf_data.sources.scans`.
        out: .ply, .obj, .off or .stl.
        box: x0 y0 z0 x1 y1 z1 in metres, in the scan's coordinates. None: the cube that kept views were
            made for, else the largest fused object (`largest_object`).
        method: `ours`, `volfus` or `tvl1`.
        resolution: voxels along the cube; None: the network's finest, 256 for the baselines.
        device: of the network.
        weight: of TV-L1; None: `DEFAULT_WEIGHTS`.
        every: take every n-th frame only.
        keep_unseen: keep the surfaces that close off what no camera has seen (see `observed`).

    Raises:
        OcnfError: the scan, the box or the run cannot be used, or no surface is left (`empty`).
    """
    if out.suffix.lower() not in WRITERS:
        raise OcnfError("cannot be written in this format", where=out, found=out.suffix,
                        expected=", ".join(WRITERS))
    chosen = parse_methods([method])[0]
    network = _load(run, device) if chosen is Method.OURS else None
    region = None if box is None else Region.of_box(box)
    mesh = fuse_scan(read_scan(scan, every=every), chosen, network, region=region, resolution=resolution,
                     weight=weight, keep_unseen=keep_unseen)
    Store(out.parent).put_bytes(out.name, WRITERS[out.suffix.lower()](mesh.vertices, mesh.faces))
    return mesh


def fuse_scan(scan: Scan, method: Method, network: OctNetFusion | None = None, *,
              region: Region | None = None, resolution: int | None = None, weight: float | None = None,
              keep_unseen: bool = False) -> FusedMesh:
    """The mesh of a scan; arguments as for `run_fuse`. The network runs where its parameters are."""
    pyramid = DepthPyramid(scan.views)
    region = region or _whole(scan) or largest_object(pyramid)
    levels = 1 if network is None else len(network.levels)
    resolution = resolution or (256 if network is None else COARSEST << (levels - 1))
    start = time.perf_counter()
    octree = reconstruct(pyramid, region, method, resolution, network, weight)
    seconds = time.perf_counter() - start
    vertices, faces = octree_surface(octree, region.side, origin=region.centre)
    kept = region.holds(vertices)
    if not keep_unseen:
        kept[kept] = observed(vertices[kept], scan.views, default_truncation(resolution, region.side))
    vertices, faces = _only(vertices, faces, kept)
    if not len(faces):
        raise OcnfError("no surface was found in the region", code="empty", field="box",
                        found=f"{region.low} to {region.high}", fix="check --box against the camera poses")
    return FusedMesh(vertices, faces, region, resolution, seconds, scan.notes)


def reconstruct(views: Views | DepthPyramid, region: Region, method: Method, resolution: int,
                network: OctNetFusion | None = None, weight: float | None = None) -> GridOctree:
    """A signed field of the region's cube, 1 channel in [-1, 1], negative inside.

    It is TSDF / tau, or 1 - 2 p of a network that gives the probability p of being occupied.

    Raises:
        OcnfError: a resolution that cannot be, or the network is missing.
    """
    side, centre = region.side, region.centre
    if method is Method.VOLFUS:
        return fuse_tsdf(views, resolution, side, origin=centre)
    if method is Method.TVL1:
        histogram = fuse_histogram(views, resolution, side, origin=centre)
        return tvl1(histogram, default_weight(resolution) if weight is None else weight)
    if network is None:
        raise OcnfError("this method needs a network", field="method", found=method)
    sizes = level_resolutions(network, resolution)
    encoding = Encoding(network.encoding)
    inputs = [OctreeBatch.from_grids([fuse(views, encoding, size, side, origin=centre)]) for size in sizes]
    *_, last = run_levels(network, inputs, next(network.parameters()).device)
    field = last.reconstruction.features
    signed = 1 - 2 * field if network.output is Output.OCCUPANCY else field.clamp(-1, 1)
    return last.reconstruction.with_features(signed).to_grids()[0]


def level_resolutions(network: OctNetFusion, finest: int) -> list[int]:
    """Resolutions of the levels, coarse to fine.

    Raises:
        OcnfError: the coarsest would not be a multiple of 32.
    """
    levels = len(network.levels)
    step = 32 << (levels - 1)
    if finest < step or finest % step:
        raise OcnfError(f"not a resolution for {levels} levels", field="resolution", found=finest,
                        expected=f"a multiple of {step}")
    return [finest >> (levels - 1 - level) for level in range(levels)]


def largest_object(views: Views | DepthPyramid) -> Region:
    """The box around the largest connected surface.

    All views are fused into a coarse TSDF (128 voxels) over the bounds of all measured points. A voxel
    belongs to a surface where the TSDF is neither free nor unseen: within 2.13 voxels of what was measured.
    Voxels that touch, if only at a corner, belong together, and the largest is the one of most voxels. What
    an object stands on is part of it: an object on a table needs a box of its own.

    Raises:
        OcnfError: nothing was measured (`empty`).
    """
    from scipy.ndimage import find_objects, label

    pyramid = views if isinstance(views, DepthPyramid) else DepthPyramid(views)
    points = _measured_points(pyramid.views)
    if not len(points):
        raise OcnfError("nothing was measured in any frame", code="empty", where="the scan")
    low, high = np.percentile(points, [_OUTLIERS, 100 - _OUTLIERS], axis=0)
    side = float((high - low).max()) * (1 + 2 * _SEARCH_MARGIN)
    x, y, z = ((low + high) / 2).tolist()
    octree = fuse_tsdf(pyramid, _SEARCH_RESOLUTION, max(side, 1e-6), origin=(x, y, z))
    labels, n = label(np.abs(octree.to_dense()[0]) < 1, np.ones((3, 3, 3)))
    if n == 0:
        raise OcnfError("no surface was found in the scan", code="empty", where="the scan")
    largest = int(np.bincount(labels.ravel())[1:].argmax())
    zyx = np.array([(span.start, span.stop) for span in find_objects(labels)[largest]])
    voxel = side / _SEARCH_RESOLUTION
    corners = (zyx[::-1].T - _SEARCH_RESOLUTION / 2) * voxel + [x, y, z]
    return Region.of_box([*corners[0], *corners[1]])


def observed(points: F64, views: Views, band: float) -> npt.NDArray[np.bool_]:
    """Which of the points (N, 3) some view has measured a surface at, to within `band` metres along its axis.

    What no view sees counts as solid in all methods, so that every reconstruction is closed by walls along
    the edges of what was seen; this tells them from surfaces.
    """
    seen = np.zeros(len(points), bool)
    height, width = views.size
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        open_ = np.flatnonzero(~seen)
        x, y, z = R @ points[open_].T + T[:, None]
        front = z > 1e-6
        open_, x, y, z = open_[front], x[front], y[front], z[front]
        u = np.floor(K[0, 0] * x / z + K[0, 2] + 0.5)
        v = np.floor(K[1, 1] * y / z + K[1, 2] + 0.5)
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        measured = depth[v[inside].astype(np.int64), u[inside].astype(np.int64)]
        near = (measured > 0) & (np.abs(measured - z[inside]) <= band)
        seen[open_[inside][near]] = True
    return seen


def _measured_points(views: Views) -> F64:
    """World positions (N, 3) of some of the pixels that hit something, spread over all views."""
    height, width = views.size
    step = max(1, int(np.sqrt(views.depth.size / _SEARCH_POINTS)))
    v, u = (axis.ravel() for axis in np.mgrid[:height:step, :width:step])
    points = [np.empty((0, 3))]
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        z = depth[v, u].astype(np.float64)
        hit = (z > 0) & np.isfinite(z)
        z = z[hit]
        camera = np.stack([(u[hit] - K[0, 2]) / K[0, 0] * z, (v[hit] - K[1, 2]) / K[1, 1] * z, z], axis=1)
        points.append((camera - T) @ R)
    return np.concatenate(points)


def _whole(scan: Scan) -> Region | None:
    """The region whose cube is the one that the views were made for."""
    if scan.cube is None:
        return None
    centre, side = scan.cube
    half = side * (1 - _PADDING) / 2
    return Region.of_box([*(c - half for c in centre), *(c + half for c in centre)])


def _only(vertices: F64, faces: I64, kept: npt.NDArray[np.bool_]) -> tuple[F64, I64]:
    """The faces whose corners are all kept, and the vertices that they use."""
    faces = faces[kept[faces].all(axis=1)]
    used = np.unique(faces)
    number = np.empty(len(vertices), np.int64)
    number[used] = np.arange(len(used))
    return vertices[used], number[faces]


def _load(run: str, device: str) -> OctNetFusion:
    from ocnf_model.checkpoint import load_run

    network: OctNetFusion = load_run(run)
    return network.to(pick_device(device)).eval()
