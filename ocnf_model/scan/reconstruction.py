"""What fusing a scan gives: the surface, the octrees that it was cut out of, and where they lie."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ocnf_data.arrays import F64, I64, U8
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.octree import GridOctree
from ocnf_model.scan.region import Region


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A surface in the scan's coordinates, and the signed distances that it is the zero crossing of.

    Attributes:
        vertices: (N, 3) float64, x y z in metres.
        faces: (M, 3) int64 indices of vertices, looking outwards.
        octrees: of the region's cube by resolution, coarse to fine, 1 channel each: TSDF / tau in [-1, 1],
            negative inside and where nothing was seen (of a network that predicts occupancy p: 1 - 2 p).
            Axes are z, y, x; `octree_surface(octrees[r], region.size, centre=region.centre)` is the surface
            of one, walls around the unseen included. Of a region that was fused with voxels of a chosen size
            there is one octree, (D, H, W), by the voxels of its longest axis.
        region: the box that surfaces were kept in, and in `size` the length of the grid's longest axis.
        truncation: tau of the finest octree in metres.
        seconds: fusion and reconstruction, without reading the scan and without marching cubes.
        notes: what the reader left out or assumed, and what it warns of, a sentence each.
        colours: (N, 3) uint8 red, green, blue of the vertices; None where the scan has no colour.
        loose: how many loose parts of the surface were left out.
        method: `ours` (the network), `volfus` or `tvl1`.
    """

    vertices: F64
    faces: I64
    octrees: Mapping[int, GridOctree]
    region: Region
    truncation: float
    seconds: float
    notes: tuple[str, ...] = ()
    colours: U8 | None = None
    loose: int = 0
    method: str = "ours"

    @property
    def voxel(self) -> float:
        """Edge length of a voxel in metres."""
        return self.region.size / self.resolution

    @property
    def resolution(self) -> int:
        """Voxels along the longest axis of the finest octree, which the surface is of."""
        return max(self.octrees)

    @property
    def octree(self) -> GridOctree:
        """The finest octree."""
        return self.octrees[self.resolution]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the mesh, with its colours where the format has a place for them.

        Args:
            path: ends in .ply, .obj, .glb, .off or .stl.

        Raises:
            OcnfError: another ending, or the file cannot be written.
        """
        file = check_format(path)
        data = WRITERS[file.suffix.lower()](self.vertices, self.faces, self.colours)
        Store(file.parent).put_bytes(file.name, data)


def check_format(path: str | os.PathLike[str]) -> Path:
    """The path, if its ending is that of a format that meshes are written in; else an OcnfError."""
    file = Path(path)
    if file.suffix.lower() not in WRITERS:
        raise OcnfError("cannot be written in this format", where=file, found=file.suffix,
                        expected=", ".join(WRITERS))
    return file
