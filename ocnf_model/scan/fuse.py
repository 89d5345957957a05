"""A depth scan to a mesh in the scan's coordinates: by the network, by VolFus or by TV-L1.

A region that fits into one cube is fused in one; where voxels of a chosen size ask for more, in overlapping
cubes, one after the other (`tiles`). Then the surface is cut out, what closes off the unseen is left out, and
so are loose parts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ocnf_data.arrays import F64, I64, U8
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_data.views.scans import Scan
from ocnf_data.views.scans.vertex_colour import colour_notes, vertex_colours, vertex_normals
from ocnf_model.scan.budget import check_memory
from ocnf_model.scan.components import LOOSE_VOXELS, check_faces, decimate, drop_loose, keep_vertices
from ocnf_model.scan.fusers import Fuser, fuse_tile
from ocnf_model.scan.reconstruction import Reconstruction
from ocnf_model.scan.region import Region, everything, largest_object, looked_at, observed
from ocnf_model.scan.seen import measured_trees
from ocnf_model.scan.stages import StageLog
from ocnf_model.scan.tiles import plan_tiles


def fuse_scan(scan: Scan, fuser: Fuser, *, region: Region | None = None, room: bool = False,
              voxel: float | None = None, keep_unseen: bool = False, keep_all: bool = False,
              faces: int | None = None, report: Callable[[int, int], None] | None = None) -> Reconstruction:
    """The surface of a scan.

    Args:
        scan: posed depth.
        fuser: the method.
        region: what part of the scan; None: the cube that its views were made for, else the largest object.
        room: everything that the frames see, in place of the largest object.
        voxel: metres; None: the region fits one cube of the method's resolution. Otherwise the region is
            worked in as many cubes as that takes, one after the other.
        keep_unseen: keep the surfaces that close off what no camera has seen (see `observed`).
        keep_all: keep loose parts of the surface, smaller than 16 voxels.
        faces: decimate to about so many.
        report: told (cubes done, cubes in all) after each; only with `voxel`.

    Raises:
        OcnfError: the region is empty, or no frame looks at it (`empty`); the voxels would need more memory
            than there is (`too_large`), or are no size.
    """
    pyramid = DepthPyramid(scan.views)
    region = choose_region(scan, pyramid, region, room)
    return reconstruct(scan, pyramid, fuser, region, voxel=voxel, keep_unseen=keep_unseen, keep_all=keep_all,
                       faces=faces, report=report)


def choose_region(scan: Scan, pyramid: DepthPyramid, region: Region | None, room: bool) -> Region:
    """The region that was asked for, or the one that is found; some frame looks at it.

    Raises:
        OcnfError: none does, or nothing was measured at all (`empty`).
    """
    refuse_both(region, room)
    if room:
        return everything(pyramid)
    if region is None:
        region = largest_object(pyramid) if scan.cube is None else Region.of_cube(*scan.cube)
    if not looked_at(scan.views, region):
        raise OcnfError("no surface was found in the region: no frame looks at it", code="empty", field="box",
                        found=f"{region.low} to {region.high}", fix="check --box against the camera poses")
    return region


def refuse_both(box: object, room: bool) -> None:
    """Raise OcnfError where both a box and the whole room are asked for, or `room` is not a truth value."""
    if not isinstance(room, bool | np.bool_):
        raise OcnfError("neither true nor false", where="fuse", field="room", found=room,
                        expected="True or False")
    if box is not None and room:
        raise OcnfError("a box and the whole room cannot both be fused", field="box", found=box,
                        expected="--box or --room")


def reconstruct(scan: Scan, pyramid: DepthPyramid, fuser: Fuser, region: Region, *,
                voxel: float | None = None, keep_unseen: bool = False, keep_all: bool = False,
                faces: int | None = None, report: Callable[[int, int], None] | None = None,
                stages: StageLog | None = None) -> Reconstruction:
    """The surface of a region of a scan whose depth pyramid is made; arguments as for `fuse_scan`.

    `stages` is told what is being done.

    Raises:
        OcnfError: no surface was found in the region (`empty`); the voxels would need more memory than there
            is (`too_large`), or are no size; `faces` is no number of faces; or a library is not installed
            (`missing_extra`).
    """
    stages = stages or StageLog()
    if faces is not None:
        check_faces(faces)
    check_memory(scan.views, region, voxel, fuser.resolution)
    began = stages.total
    octrees, grid, truncation = _fuse(pyramid, fuser, region, voxel, stages, report)
    seconds = stages.total - began
    with stages.stage("surface") as stage:
        octree = octrees[max(octrees)]
        trees = None if keep_unseen else measured_trees(scan.views, grid, octree.shape, truncation)
        vertices, triangles = octree_surface(octree, grid.size, centre=grid.centre, trees=trees,
                                             report=stage.report)
        stage.say(f"{len(triangles):,} faces by marching cubes")
    with stages.stage("clean") as stage:
        kept = region.holds(vertices)
        if not keep_unseen:
            kept[kept] = observed(vertices[kept], scan.views, truncation)
        vertices, triangles = keep_vertices(vertices, triangles, kept)
        if not len(triangles):
            raise OcnfError("no surface was found in the region", code="empty", field="box",
                            found=f"{region.low} to {region.high}",
                            fix="look at the box with --preview PICTURE")
        said = [f"{len(triangles):,} faces of what was seen"]
        loose = 0
        if not keep_all:
            vertices, triangles, loose = drop_loose(vertices, triangles,
                                                    LOOSE_VOXELS * grid.size / max(octrees))
            said.append(f"{loose:,} loose parts dropped" if loose != 1 else "1 loose part dropped")
        if faces is not None:
            vertices, triangles = decimate(vertices, triangles, faces)
            said.append(f"decimated to {len(triangles):,}")
        stage.say(", ".join(said))
    colours, lacking = _colours(scan, vertices, triangles, truncation, stages)
    return Reconstruction(vertices, triangles, octrees, grid, truncation, seconds,
                          (*scan.notes, *lacking, *scan.warnings), colours, loose, str(fuser.method))


def _colours(scan: Scan, vertices: F64, triangles: I64, truncation: float,
             stages: StageLog) -> tuple[U8 | None, list[str]]:
    """Colours of the vertices, and notes on images that cannot be read: they never cost the surface."""
    if scan.colour is None:
        return None, []
    faults: list[OcnfError] = []
    with stages.stage("colour") as stage:
        normals = vertex_normals(vertices, triangles)
        colours, _ = vertex_colours(vertices, scan, truncation, normals, faults.append)
        images = sum(image is not None for image in scan.colour.images) - len(faults)
        stage.say(f"{len(vertices):,} vertices from {images} images")
    notes = colour_notes(faults, len(scan.views))
    stages.note(notes)
    return colours if images else None, notes


def _fuse(pyramid: DepthPyramid, fuser: Fuser, region: Region, voxel: float | None, stages: StageLog,
          report: Callable[[int, int], None] | None) -> tuple[Mapping[int, GridOctree], Region, float]:
    """The octrees by resolution, the region with the size of their grid, and tau in metres."""
    label = fuser.method.label
    with stages.stage("fuse") as stage:
        if voxel is None:
            octrees = fuser(pyramid, region, stage.report)
            stage.say(f"{label}, {fuser.resolution}³ voxels of "
                      f"{1000 * region.size / fuser.resolution:.2f} mm")
            return octrees, region, fuser.truncation(region.size / fuser.resolution)
        lengths = np.subtract(region.high, region.low)
        fuser = fuser.for_voxels(int(np.ceil(lengths.max() / voxel)) + 16)
        tiling = plan_tiles(region, voxel, fuser.resolution, fuser.overlap)
        results, tiles = [], tiling.tiles
        for cube in tiles:
            results.append(fuse_tile(fuser, pyramid, cube))
            for told in (stage.report, report):
                if told is not None:
                    told(len(results), len(tiles))
        octree = tiling.merge(results)
        d, h, w = tiling.shape
        stage.say(f"{label}, {w} x {h} x {d} voxels of {1000 * voxel:.2f} mm in {len(tiles)} "
                  f"tile{'s' * (len(tiles) > 1)} of {fuser.resolution}³")
        grid = replace(region, size=tiling.region.size)
        return {max(tiling.shape): octree}, grid, fuser.truncation(voxel)
