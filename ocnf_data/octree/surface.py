"""Surfaces out of TSDF octrees."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import F64, I64, Bool
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.octree import GridOctree
from ocnf_data.octree.boxes import cut_trees
from ocnf_data.octree.windows import Place, Windows

_CLEAR = np.float32(1e-3)
"""How far (a share of tau, about 0.002 voxels) values are kept from the level: nothing visible moves."""


class _Piece(NamedTuple):
    """The surface within a window.

    Attributes:
        zyx: (n, 3) vertices, in voxels of `Windows`.
        faces: (m, 3).
        shared: (k,) vertices on the window's sides, which windows beside it have too.
        edges: (k,) numbers of the voxel edges that those lie on.
    """

    zyx: F64
    faces: I64
    shared: I64
    edges: I64


def octree_surface(octree: GridOctree, extent: float = 3.0, level: float = 0.0,
                   centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
                   trees: Bool | None = None, report: Callable[[int, int], None] | None = None,
                   ) -> tuple[F64, I64]:
    """Marching cubes of a TSDF octree: a closed surface around what lies below `level`, facing outwards.

    Every edge belongs to exactly two faces. Beyond the grid's border everything is free, so that a solid cut
    off there is closed too. It is worked window by window (64 voxels), and only where the surface passes: the
    memory is that of the result.

    Args:
        octree: 1 channel, TSDF / tau: negative inside.
        extent: length of the grid along its longest axis in metres.
        level: in units of tau; above 0 the surface lies outside of the measured one.
        centre: world position (x, y, z) of the grid's centre in metres.
        trees: (GD, GH, GW) in which trees the surface is cut out, and perhaps a voxel beyond; None: in all.
            Where they end the surface is open.
        report: told (windows done, windows in all) after each.

    Returns:
        vertices (N, 3) in metres, x y z, and faces (M, 3); both empty where nothing is below `level`.

    Raises:
        OcnfError: `level` is not between -1 and 1, the octree has not 1 channel, or scikit-image is not
            installed (`missing_extra`).
    """
    if not -1 < level < 1:  # NaN is refused too
        raise OcnfError("not a level between inside and free", where="octree_surface", field="level",
                        found=level, expected="more than -1 and less than 1 truncation")
    if octree.channels != 1:
        raise OcnfError("not a TSDF", where="octree_surface", found=f"{octree.channels} channels", expected=1)
    try:
        import skimage.measure  # noqa: F401
    except ImportError as error:
        raise missing_extra("marching cubes needs scikit-image", "fuse") from error
    windows = Windows(octree, level, _CLEAR, trees)
    places = windows.places()
    pieces: dict[Place, _Piece] = {}
    for done, place in enumerate(places, 1):
        pieces[place] = _cut(windows, place)
        if report is not None:
            report(done, len(places))
    _mend(windows, pieces)
    zyx, faces = _joined(pieces[place] for place in sorted(pieces))
    size = extent / max(octree.shape)
    middle = np.array(octree.shape[::-1]) / 2
    return (zyx[:, ::-1] - 0.5 - middle) * size + centre, faces


def _cut(windows: Windows, place: Place) -> _Piece:
    from skimage.measure import marching_cubes

    values = windows.values(place)
    nothing = _Piece(np.empty((0, 3)), np.empty((0, 3), np.int64), *[np.empty(0, np.int64)] * 2)
    if not values.min() < 0 < values.max():  # the other sign was in a tree beside the window
        return nothing
    try:
        local, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="ascent",
                                            mask=windows.counted(place, values.shape))
    except RuntimeError:  # how it says that no cell that counts has a surface
        return nothing
    below = np.floor(local).astype(np.int64)
    across = local > below
    # A vertex lies on the edge between two voxels, or (some tables of Lewiner's) in the middle of a cell.
    on_side = ((below == 0) | (below == np.array(values.shape) - 1)) & ~across
    shared = np.flatnonzero(on_side.any(axis=1) & (across.sum(axis=1) == 1))
    corner = windows.corner(place)
    number = np.ravel_multi_index(tuple((below[shared] + corner).T), windows.shape)
    return _Piece(local.astype(np.float64) + corner, faces.astype(np.int64), shared,
                  3 * number + across[shared].argmax(axis=1))


def _joined(pieces: Iterable[_Piece]) -> tuple[F64, I64]:
    """Vertices (N, 3) and faces (M, 3) of pieces whose shared vertices are one each."""
    kept = [piece for piece in pieces if len(piece.faces)]
    if not kept:
        return np.empty((0, 3)), np.empty((0, 3), np.int64)
    first = np.cumsum([0, *(len(piece.zyx) for piece in kept)])
    shared = np.concatenate([piece.shared + start for piece, start in zip(kept, first, strict=False)])
    _, one, which = np.unique(np.concatenate([piece.edges for piece in kept]), return_index=True,
                              return_inverse=True)
    same = np.arange(first[-1])
    same[shared] = shared[one][which]
    used = same == np.arange(first[-1])
    number = np.cumsum(used) - 1
    zyx = np.concatenate([piece.zyx for piece in kept])[used]
    faces = np.concatenate([piece.faces + start for piece, start in zip(kept, first, strict=False)])
    return zyx, number[same[faces]]


def _mend(windows: Windows, pieces: dict[Place, _Piece]) -> None:
    """Cut windows again, with a voxel made solid, wherever an edge belongs to more than two faces.

    Nothing is ever made free, so that this comes to an end. Only what changed and what is beside it is looked
    at again.
    """
    looked_at: Mapping[Place, _Piece] = pieces
    while looked_at:
        zyx, faces = _joined(looked_at[place] for place in sorted(looked_at))
        crowded = _crowded_edges(faces)
        changed: set[Place] = set()
        for voxel in _to_fill(windows, zyx[crowded].mean(axis=1)):
            changed |= windows.around(voxel)
        for place in changed:
            pieces[place] = _cut(windows, place)
        beside = {(z + dz, y + dy, x + dx) for z, y, x in changed
                  for dz, dy, dx in itertools.product((-1, 0, 1), repeat=3)}
        looked_at = {place: piece for place, piece in pieces.items() if place in beside}


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
    return cut_trees(octree, low, high), low


def _crowded_edges(faces: npt.NDArray[np.integer]) -> I64:
    """Edges (k, 2) that belong to more than two faces.

    The tables of marching cubes (Lewiner et al. 2003) leave some: two tunnels that meet at the same face of
    a cell both use a diagonal of that face.
    """
    if not len(faces):
        return np.empty((0, 2), np.int64)
    n = int(faces.max()) + 1
    a = faces.astype(np.int64)
    b = np.roll(a, -1, axis=1)
    codes = np.sort((np.minimum(a, b) * n + np.maximum(a, b)).ravel())
    crowded = np.unique(codes[2:][codes[2:] == codes[:-2]])
    return np.stack([crowded // n, crowded % n], axis=1)


def _to_fill(windows: Windows, middles: F64) -> list[Place]:
    """Make one more voxel solid at every face of a cell in which a point of `middles` (k, 3), z y x, lies.

    Of its two free voxels, which alternate with two solid ones, it is the one nearer to the surface. What is
    solid already stays: what a face before it has filled.
    """
    filled = []
    for middle in middles:
        spans = [range(int(np.floor(c)), int(np.ceil(c)) + 1) for c in middle]
        voxels = np.array(list(itertools.product(*spans)), np.int64)
        values = windows.at(voxels)
        if not (values > 0).any():
            continue
        least = values[values > 0].min()
        for z, y, x in voxels[values == least].tolist():
            windows.make_solid((z, y, x))
            filled.append((z, y, x))
    return filled
