"""Surfaces out of TSDF octrees."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import F32, F64, I64
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.octree import GridOctree

# A value of exactly the level at a voxel would put up to six vertices in one place. This far from it (a
# share of tau, about 0.002 voxels) each vertex has a place of its own, and nothing visible moves.
_CLEAR = np.float32(1e-3)


def octree_surface(octree: GridOctree, extent: float = 3.0, level: float = 0.0,
                   centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> tuple[F64, I64]:
    """Marching cubes of a TSDF octree: a closed surface around what lies below `level`, facing outwards.

    Every edge belongs to exactly two faces. Beyond the grid's border everything is free, so that a solid cut
    off there is closed too. Only the trees that are not wholly free are expanded.

    Args:
        octree: 1 channel, TSDF / tau: negative inside.
        extent: length of the grid along its longest axis in metres.
        level: in units of tau; above 0 the surface lies outside of the measured one.
        centre: world position (x, y, z) of the grid's centre in metres.

    Returns:
        vertices (N, 3) in metres, x y z, and faces (M, 3); both empty where nothing is below `level`.
    """
    if not -1 < level < 1:  # NaN is refused too
        raise OcnfError("not a level between inside and free", where="octree_surface", field="level",
                        found=level, expected="more than -1 and less than 1 truncation")
    if octree.channels != 1:
        raise OcnfError("not a TSDF", where="octree_surface", found=f"{octree.channels} channels", expected=1)
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise missing_extra("marching cubes needs scikit-image", "fuse") from error
    cropped, first_tree = occupied_box(octree, level)
    if cropped is None:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    values = np.pad(cropped.to_dense()[0], 1, constant_values=1.0) - np.float32(level)
    near = np.abs(values) < _CLEAR
    values[near] = np.where(values[near] < 0, -_CLEAR, _CLEAR)
    zyx, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="ascent")
    while len(crowded := _crowded_edges(faces)) and _fill(values, zyx[crowded].mean(axis=1)):
        zyx, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="ascent")
    size = extent / max(octree.shape)
    index = zyx[:, ::-1].astype(np.float64) - 1 + 8 * first_tree[::-1]  # voxels x y z; 1 is the border
    middle = np.array(octree.shape[::-1]) / 2
    return (index + 0.5 - middle) * size + centre, faces.astype(np.int64)


def occupied_box(octree: GridOctree, level: float = 0.0) -> tuple[GridOctree | None, I64]:
    """The box of trees around all that are not wholly free, and its first tree (gd, gh, gw).

    None in place of the box where nothing lies below `level`.
    """
    grid = octree.trees.shape[:3]
    if not (octree.data[:, 0] < level).any():
        return None, np.zeros(3, np.int64)
    lowest = np.minimum.reduceat(octree.data[:, 0], octree.prefix[:-1]).reshape(grid)
    where = np.argwhere(lowest < 1)
    low, high = where.min(axis=0), where.max(axis=0) + 1
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    chosen = np.zeros(grid, bool)
    chosen[box] = True
    rows = np.repeat(chosen.ravel(), np.diff(octree.prefix))
    return GridOctree(np.ascontiguousarray(octree.trees[box]), np.ascontiguousarray(octree.data[rows])), low


def _crowded_edges(faces: npt.NDArray[np.integer]) -> I64:
    """Edges (k, 2) that belong to more than two faces.

    The tables of marching cubes (Lewiner et al. 2003) leave some: two tunnels that meet at the same face of
    a cell both use a diagonal of that face.
    """
    n = int(faces.max()) + 1
    a = faces.astype(np.int64)
    b = np.roll(a, -1, axis=1)
    codes = np.sort((np.minimum(a, b) * n + np.maximum(a, b)).ravel())
    crowded = np.unique(codes[2:][codes[2:] == codes[:-2]])
    return np.stack([crowded // n, crowded % n], axis=1)


def _fill(values: F32, middles: npt.NDArray[np.floating]) -> bool:
    """Make one more voxel solid at every face of a cell in which a point of `middles` (k, 3), z y x, lies.

    Of its two free voxels, which alternate with two solid ones, it is the one nearer to the surface. Nothing
    is ever made free, so that repeating this comes to an end. False if there was nothing left to fill.
    """
    n_free = 0
    for middle in middles:
        face = values[tuple(slice(int(np.floor(c)), int(np.ceil(c)) + 1) for c in middle)]
        free = face > 0
        n_free += int(free.sum())
        face[face == face[free].min(initial=np.inf)] = -_CLEAR
    return n_free > 0
