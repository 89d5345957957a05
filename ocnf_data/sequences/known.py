"""The part of a fused surface that was measured, without the walls around what no frame has seen."""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface

_ON_GRID = 1e-4  # voxels


def known_surface(tsdf: GridOctree, extent: float, known: GridOctree | None = None) -> tuple[F64, I64]:
    """The surface between voxels that are known, as triangles: vertices (N, 3) metres, faces (M, 3).

    What no view counts is -1 and closes every reconstruction by walls. A measured surface has voxels before
    and behind it that some view counts: a face stays where those on both sides of its corners are above -1.

    Args:
        tsdf: TSDF / tau.
        extent: edge length of its cube in metres, centred at the origin.
        known: the TSDF / tau, of the same resolution, that says what is known, such as the reference's where
            `tsdf` is a network's; None: `tsdf` itself.
    """
    known = tsdf if known is None else known
    vertices, faces = octree_surface(tsdf, extent)
    place = ((vertices + extent / 2) * max(tsdf.shape) / extent - 0.5)[:, ::-1]  # voxels: z, y, x
    kept = np.ones(len(vertices), bool)
    for cells in (np.floor(place + _ON_GRID), np.ceil(place - _ON_GRID)):
        inside = np.clip(cells, 0, np.array(tsdf.shape) - 1).astype(np.int64)
        kept &= (cells == inside).all(axis=1)  # beyond the grid nothing is known
        kept &= known.gather(inside)[:, 0] > -1
    faces = faces[kept[faces].all(axis=1)]
    used, corners = np.unique(faces, return_inverse=True)
    return vertices[used], corners.reshape(-1, 3).astype(np.int64)
