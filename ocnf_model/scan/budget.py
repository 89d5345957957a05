"""How much memory a region takes at a voxel size, before it is taken."""

from __future__ import annotations

import os

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.sequences.cube import measured_points
from ocnf_data.views.cameras import Views
from ocnf_model.scan.region import Region

_CELLS = 64  # along the region's longest axis, of the estimate of its surface
_BYTES_A_SURFACE_VOXEL = 1200
"""The octrees of the tiles and of the whole about a voxel of surface, and two faces and a vertex, some of
which are there several times while marching cubes joins them and loose parts are dropped; as measured."""
_BYTES_A_TREE = 60  # 16 of the tree, 8 of its place, some of these more than once
_SHARE = 0.7  # of the machine's memory


def estimate_bytes(views: Views, region: Region, voxel: float) -> float:
    """Bytes that the surface of a region takes, its grid and its mesh, without the tile that is worked on.

    The area is that of the coarse cells that measured points lie in, a face each.

    Args:
        views: the depth maps.
        region: its box counts.
        voxel: metres.
    """
    points = measured_points(views)
    lengths = np.subtract(region.high, region.low)
    cell = float(lengths.max()) / _CELLS
    cells = np.unique(np.floor((points[region.holds(points)] - region.low) / cell).astype(np.int64), axis=0)
    surface = len(cells) * (cell / voxel) ** 2
    trees = float(np.prod(lengths / voxel / 8 + 1))
    return _BYTES_A_SURFACE_VOXEL * surface + _BYTES_A_TREE * trees


def check_memory(views: Views, region: Region, voxel: float) -> None:
    """Refuse a voxel size at which the surface does not fit into this machine's memory.

    Raises:
        OcnfError: that, with the code `too_large`; or a size that is not one.
    """
    longest = float(np.subtract(region.high, region.low).max())
    if not (np.isfinite(voxel) and voxel > 0):
        raise OcnfError("not the size of a voxel", field="voxel", found=voxel, expected="metres, above 0")
    if longest / voxel < 8:
        raise OcnfError("the voxels are too large for the region", field="voxel", found=f"{voxel:g} m",
                        expected=f"at most {longest / 8:.2g} m, an eighth of the region's longest side")
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    needed = estimate_bytes(views, region, voxel)
    if needed > _SHARE * memory:
        enough = voxel
        while estimate_bytes(views, region, enough) > _SHARE * memory:
            enough *= 1.1
        raise OcnfError("the surface would not fit into memory at this voxel size", code="too_large",
                        field="voxel", found=f"{voxel:g} m, about {needed / 1e9:,.0f} GB",
                        expected=f"at most {_SHARE * memory / 1e9:,.0f} GB of this machine's "
                                 f"{memory / 1e9:,.0f}",
                        fix=f"take --voxel {enough:.2g} or more, or a smaller --box")
