"""A depth scan to a mesh in the scan's coordinates: by the network, by VolFus or by TV-L1.

The network knows one cube. A region of the scan takes that cube's place: fusion measures everything in
voxels and in truncations, so that a cube of any size, anywhere, gives what the scan would, were it moved and
scaled into the cube of training, and the surface is in the scan's coordinates at once.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ocnf_data.arrays import F64, I64, Bool
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid, default_truncation, fuse, fuse_histogram, fuse_tsdf
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_data.views.scans import Scan, read_scan
from ocnf_data.views.scans.vertex_colour import vertex_colours, vertex_normals
from ocnf_model.baselines import tvl1
from ocnf_model.checkpoint import TrainedRun, open_run
from ocnf_model.devices import pick_device
from ocnf_model.evaluation.levels import run_levels
from ocnf_model.evaluation.methods import Method, default_weight, parse_methods
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.scan.reconstruction import Reconstruction, check_format
from ocnf_model.scan.region import Region, largest_object, looked_at, observed


def run_fuse(run: str, scan: str, *, out: Path, box: tuple[float, ...] | None = None, method: str = "ours",
             resolution: int | None = None, device: str = "auto", weight: float | None = None,
             every: int = 1, keep_unseen: bool = False, console: Console | None = None,
             reading: Mapping[str, Any] | None = None) -> Reconstruction:
    """Fuse a scan, write the mesh, and say what was done.

    Args:
        run: a training run, or `pretrained`; read only where the method is `ours`.
        scan: a scan in any format that `ocnf_data.views.scans` reads.
        out: .ply, .obj, .off or .stl.
        box: x0 y0 z0 x1 y1 z1 in metres, in the scan's coordinates. None: the cube that kept views were
            made for, else the largest fused object (`largest_object`).
        method: `ours`, `volfus` or `tvl1`.
        resolution: voxels along the cube; None: the network's finest, 256 for the baselines.
        device: where the network runs: auto, cpu, cuda, ...
        weight: weight of TV-L1's data term, above 0; None: that of `DEFAULT_WEIGHTS`.
        every: take every n-th frame only.
        keep_unseen: keep the surfaces that close off what no camera has seen (see `observed`).
        console: where the summary is printed.
        reading: further arguments of `read_scan`.

    Raises:
        OcnfError: the scan, the box or the run cannot be used, or no surface is left (`empty`).
    """
    check_format(out)
    chosen = parse_methods([method])[0]
    region = None if box is None else Region.of_box(box)
    fuser = _fuser(run, chosen, resolution, device, weight)
    read = read_scan(scan, every=every, **(reading or {}))
    console = console or Console()
    for note in (*read.notes, *read.warnings):  # before anything fails for the reason that they give
        console.print(f"Note: {note}", highlight=False, markup=False)
    mesh = fuse_scan(read, fuser, region=region, keep_unseen=keep_unseen)
    mesh.save(out)
    console.print(f"{out}: {len(mesh.faces):,} faces by {chosen.label} at {mesh.resolution}³ in "
                  f"{mesh.seconds:.1f} s, {mesh.region}", highlight=False, markup=False, soft_wrap=True)
    return mesh


@dataclass(frozen=True)
class Baseline:
    """VolFus, or TV-L1 where there is a weight."""

    resolution: int = 256
    weight: float | None = None

    def __call__(self, pyramid: DepthPyramid, region: Region) -> dict[int, GridOctree]:
        """The region's cube by resolution, of which there is one: TSDF / tau, 1 channel."""
        size, centre = region.size, region.centre
        if self.weight is None:
            return {self.resolution: fuse_tsdf(pyramid, self.resolution, size, centre=centre)}
        votes = fuse_histogram(pyramid, self.resolution, size, centre=centre)
        return {self.resolution: tvl1(votes, self.weight)}


@dataclass(frozen=True, eq=False)
class Learned:
    """The network.

    Attributes:
        network: the network in evaluation mode, on the device that it runs on.
        resolutions: resolutions of its levels, coarse to fine; a shorter list makes it stop early.
        truncation_voxels: truncation distance in voxels that it was trained with.
    """

    network: OctNetFusion
    resolutions: Sequence[int]
    truncation_voxels: float = 32 / 15

    @classmethod
    def of(cls, trained: TrainedRun, resolution: int | None = None) -> Learned:
        """A run's network up to the level of a resolution; None: all its levels.

        Raises:
            OcnfError: it has no such level.
        """
        levels = trained.resolutions
        if resolution is not None and resolution not in levels:
            raise OcnfError("the network has no level of this resolution", where=trained.path,
                            field="resolution", found=resolution, expected=" or ".join(map(str, levels)))
        used = levels[: levels.index(resolution) + 1] if resolution else levels
        return cls(trained.network, used, trained.data.truncation_voxels)

    @property
    def resolution(self) -> int:
        """Voxels along each axis of the finest level."""
        return self.resolutions[-1]

    def __call__(self, pyramid: DepthPyramid, region: Region) -> dict[int, GridOctree]:
        """The region's cube by resolution, coarse to fine, 1 channel each.

        TSDF / tau, or 1 - 2 p of the probability p of being occupied.
        """
        network, size = self.network, region.size
        inputs = [OctreeBatch.from_grids([
            fuse(pyramid, network.encoding, resolution, size, self.truncation_voxels * size / resolution,
                 centre=region.centre)]) for resolution in self.resolutions]
        reached = run_levels(network, inputs, next(network.parameters()).device)
        return {resolution: self._signed(level.reconstruction)
                for resolution, level in zip(self.resolutions, reached, strict=True)}

    def _signed(self, reconstruction: OctreeBatch) -> GridOctree:
        field = reconstruction.features
        signed = 1 - 2 * field if self.network.output is Output.OCCUPANCY else field.clamp(-1, 1)
        return reconstruction.with_features(signed).to_grids()[0]


Fuser = Baseline | Learned


def fuse_scan(scan: Scan, fuser: Fuser, *, region: Region | None = None,
              keep_unseen: bool = False) -> Reconstruction:
    """The surface of a scan; arguments as for `run_fuse`."""
    pyramid = DepthPyramid(scan.views)
    if region is None:
        region = largest_object(pyramid) if scan.cube is None else Region.of_cube(*scan.cube)
    if not looked_at(scan.views, region):
        raise OcnfError("no surface was found in the region: no frame looks at it", code="empty", field="box",
                        found=f"{region.low} to {region.high}", fix="check --box against the camera poses")
    start = time.perf_counter()
    octrees = fuser(pyramid, region)
    seconds = time.perf_counter() - start
    vertices, faces = octree_surface(octrees[fuser.resolution], region.size, centre=region.centre)
    kept = region.holds(vertices)
    if not keep_unseen:
        kept[kept] = observed(vertices[kept], scan.views, default_truncation(fuser.resolution, region.size))
    vertices, faces = _only(vertices, faces, kept)
    if not len(faces):
        raise OcnfError("no surface was found in the region", code="empty", field="box",
                        found=f"{region.low} to {region.high}", fix="check --box against the camera poses")
    colours = None if scan.colour is None else vertex_colours(
        vertices, scan, default_truncation(fuser.resolution, region.size), vertex_normals(vertices, faces))[0]
    return Reconstruction(vertices, faces, octrees, region, seconds, (*scan.notes, *scan.warnings), colours)


def _only(vertices: F64, faces: I64, kept: Bool) -> tuple[F64, I64]:
    """The faces whose corners are all kept, and the vertices that they use."""
    faces = faces[kept[faces].all(axis=1)]
    used = np.unique(faces)
    number = np.empty(len(vertices), np.int64)
    number[used] = np.arange(len(used))
    return vertices[used], number[faces]


def _fuser(run: str, method: Method, resolution: int | None, device: str, weight: float | None) -> Fuser:
    if method is Method.VOLFUS:
        return Baseline(resolution or 256)
    if method is Method.TVL1:
        return Baseline(resolution or 256, weight or default_weight(resolution or 256))
    trained = open_run(run)
    trained.network.to(pick_device(device))
    return Learned.of(trained, resolution)
