"""How much memory a region takes at a voxel size, before it is taken."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.files.memory import usable_memory
from ocnf_data.sequences.cube import measured_points
from ocnf_data.views.cameras import Views
from ocnf_model.scan.region import Region

_CELLS = 64  # along the region's longest axis, of the estimate of its surface
_BYTES_A_SURFACE_VOXEL = 1200
"""The octrees of the tiles and of the whole about a voxel of surface, and two faces and a vertex, some of
which are there several times while marching cubes joins them and loose parts are dropped; as measured."""
_BYTES_A_TREE = 60  # 16 of the tree, 8 of its place, some of these more than once
_SHARE = 0.7  # of the memory that may be used
_FINEST = 1e-12  # of the region: what finer voxels take is too much for a float


def estimate_bytes(views: Views, region: Region, voxel: float) -> float:
    """Bytes that the surface of a region takes, its grid and its mesh, without the tile that is worked on.

    The area is that of the coarse cells that measured points lie in, a face each.

    Args:
        views: the depth maps.
        region: its box counts.
        voxel: metres.
    """
    return _bytes(_area(views, region), region, voxel)


def check_voxel(voxel: float) -> None:
    """Raise OcnfError unless it is the size of a voxel."""
    if not (isinstance(voxel, Real) and np.isfinite(voxel) and voxel > 0):
        raise OcnfError("not the size of a voxel", field="voxel", found=voxel, expected="metres, above 0")


def check_memory(views: Views, region: Region, voxel: float | None, resolution: int) -> None:
    """Refuse voxels so small that the surface does not fit into memory, or too large ones.

    Args:
        views: the depth maps.
        region: its box counts.
        voxel: metres; None: the region is one cube of `resolution` voxels along each axis.
        resolution: counts only then, and is what the message names.

    Raises:
        OcnfError: that, with the code `too_large`; or a size that is not one.
    """
    longest = float(np.subtract(region.high, region.low).max())
    if voxel is not None:
        check_voxel(voxel)
    edge = region.size / resolution if voxel is None else voxel
    field, found = ("resolution", f"{resolution}") if voxel is None else ("voxel", f"{voxel:g} m")
    if longest / edge < 8:
        most = f"at most {_two_digits(longest / 8):g} m, an eighth of the region's longest side"
        raise OcnfError("the voxels are too large for the region", field=field, found=found,
                        expected="16 or more" if voxel is None else most)
    memory = usable_memory()
    limit, area = _SHARE * memory, _area(views, region)
    needed = _bytes(area, region, edge)
    if needed > limit:
        fitting = _fitting(area, region, edge, limit)
        fix = (f"--resolution {int(region.size / fitting) // 8 * 8} or less" if voxel is None else
               f"--voxel {_two_digits(fitting, up=True):g} or more")
        raise OcnfError("the surface would not fit into memory at this voxel size", code="too_large",
                        field=field, found=f"{found}, about {math.ceil(needed / 1e8) / 10:,.1f} GB",
                        expected=f"at most {math.floor(limit / 1e8) / 10:,.1f} GB of the "
                                 f"{memory / 1e9:,.1f} that may be used",
                        fix=f"take {fix}, or a smaller --box")


def _area(views: Views, region: Region) -> float:
    """Square metres of the surface within a region, which takes all measured points: seconds."""
    points = measured_points(views)
    cell = float(np.subtract(region.high, region.low).max()) / _CELLS
    cells = np.unique(np.floor((points[region.holds(points)] - region.low) / cell).astype(np.int64), axis=0)
    return len(cells) * cell**2


def _bytes(area: float, region: Region, voxel: float) -> float:
    lengths = np.subtract(region.high, region.low)
    voxel = max(voxel, _FINEST * float(lengths.max()))
    trees = float(np.prod(lengths / voxel / 8 + 1))
    return _BYTES_A_SURFACE_VOXEL * area / voxel**2 + _BYTES_A_TREE * trees


def _fitting(area: float, region: Region, voxel: float, limit: float) -> float:
    """About the smallest voxel, not below `voxel`, whose surface takes no more than `limit` bytes."""
    voxel = max(voxel, _FINEST * region.size)
    while _bytes(area, region, voxel) > limit:
        voxel *= 1.1
    return voxel


def _two_digits(length: float, up: bool = False) -> float:
    """A length with two digits, which is no larger than it is, or (`up`) no smaller."""
    nearest = float(f"{length:.2g}")
    step = 10.0 ** (math.floor(math.log10(length)) - 1)
    if up and nearest < length:
        nearest += step
    elif not up and nearest > length:
        nearest -= step
    return float(f"{nearest:.2g}")
