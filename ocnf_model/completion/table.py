"""The table in a depth map, and the grid over what stands on it.

Completion knows grids with z up, whose table lies just below what is judged (`Tabletop`, `LOWEST`). A depth
map of somebody's own has neither: the table is the plane that most of its points lie on, found by RANSAC
(Fischler and Bolles 1981), and the things are what rises above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F64, U8, Bool
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.sequences.cube import measured_points
from ocnf_data.views.cameras import Views
from ocnf_model.completion.sample import SHRINK, SIZE
from ocnf_model.completion.visible import LOWEST

_POINTS = 20_000  # that planes are tried on
_TRIES = 500
_NEAR = 0.01  # metres from the plane within which a point lies on it
_LEAST = 0.2  # share of the points that a table has at least
_ABOVE, _TALLEST = 0.015, 0.39  # metres above the table within which there are things
_CELL = 0.01  # metres of the map of the table
_SHARP = 0.2  # tangent of the angle from the middle of the picture at which things draw 0.6 of its attention
_GAP = 0.06  # metres between things that belong together
_RIM = 0.08  # metres within the table's outline and around what is taller that do not count: feet of walls
_MARGIN = 0.15  # metres of the grid around the things, as in training
_DEPTH = 80  # voxels
VOXEL = 0.005
"""Edge length of a voxel in metres, which the network was trained with."""


@dataclass(frozen=True)
class TableGrid:
    """Where a grid lies in the world of a view.

    Attributes:
        to_grid: (4, 4) from the world to the grid's coordinates: metres, a corner at the origin, z up, the
            table one voxel below the `LOWEST` that is judged.
        shape: (D, H, W) voxels of `VOXEL`.
    """

    to_grid: F64
    shape: tuple[int, int, int]

    def place(self, view: Views) -> Views:
        """The view with its camera in the grid's coordinates."""
        to_world = np.linalg.inv(self.to_grid)
        return Views(view.depth, view.K, view.R @ to_world[:3, :3], view.R @ to_world[:3, 3] + view.T)

    def leave(self, points: F64) -> F64:
        """Points (N, 3) of the grid in the world's coordinates."""
        to_world = np.linalg.inv(self.to_grid)
        return np.asarray(points @ to_world[:3, :3].T + to_world[:3, 3])


def find_table(view: Views, where: object = "complete") -> TableGrid:
    """The grid over the things on the table that one view sees.

    The things are the group that is looked at most of those within the table's convex outline, none of them
    farther than 6 cm from the next, up to 39 cm above it.

    Args:
        view: one view.
        where: names the frame in errors.

    Raises:
        OcnfError: code `empty`: no plane holds a fifth of the points, or nothing stands on it; `too_large`:
            the things do not fit into the network's grid.
    """
    points = measured_points(view)
    if len(points) < 1000:
        raise OcnfError("too little was measured to find a table", code="empty", where=where,
                        found=f"{len(points)} pixels", expected="1000 or more")
    some = points[np.random.default_rng(0).permutation(len(points))[:_POINTS]]
    normal, offset = _plane(some, view.centres[0], -view.R[0, 1])
    share = float((np.abs(some @ normal - offset) < _NEAR).mean())
    if share < _LEAST:
        raise OcnfError("no table was found", code="empty", where=where,
                        found=f"a plane with {share:.0%} of what was measured",
                        expected=f"{_LEAST:.0%} or more",
                        fix="take a frame that looks down on a flat table")
    turn = _axes(normal, view.R[0])
    flat = points @ turn.T - [0, 0, offset]  # x, y on the table, z above it
    low, high = _things(flat, _attention(points, view), where)
    size = np.ceil((high - low) / VOXEL).astype(int)
    if size.max() > SHRINK * SIZE:
        raise OcnfError("what stands on the table does not fit into the network's grid", code="too_large",
                        where=where, found=f"{size.max() * VOXEL:.2f} m",
                        expected=f"at most {SHRINK * SIZE * VOXEL} m with a margin of {_MARGIN} m",
                        fix="take a frame with fewer things, or from nearer")
    to_grid = np.eye(4)
    to_grid[:3, :3] = turn
    to_grid[:3, 3] = -low[0], -low[1], (LOWEST - 1) * VOXEL - offset
    return TableGrid(to_grid, (_DEPTH, int(size[1]), int(size[0])))


def _plane(points: F64, camera: F64, up: F64) -> tuple[F64, float]:
    """(normal, offset) of the plane `normal @ p = offset` that most points lie on, fitted to those.

    The normal looks to the camera's side, and not against the picture's upward direction, as that of a wall
    does before a camera that looks down.
    """
    rng = np.random.default_rng(0)
    a, b, c = np.moveaxis(points[rng.integers(0, len(points), (_TRIES, 3))], 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    good = lengths > 1e-6  # of square metres: triples on a line
    normals, a = normals[good] / lengths[good, None], a[good]
    few = points[:: max(1, len(points) // 4000)]
    normals *= np.where(((camera - a) * normals).sum(axis=1, keepdims=True) < 0, -1, 1)
    upward = normals @ up > 0
    normals, a = normals[upward], a[upward]
    offsets = (normals * a).sum(axis=1)
    hits = [(np.abs(few @ n - d) < _NEAR).sum() for n, d in zip(normals, offsets, strict=True)]
    best = int(np.argmax(hits))
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        own = points[np.abs(points @ normal - offset) < _NEAR]
        middle = own.mean(axis=0)
        fitted = np.linalg.svd(own - middle, full_matrices=False)[2][2]
        normal = fitted if fitted @ normal > 0 else -fitted
        offset = float(middle @ normal)
    return normal, offset


def _axes(up: F64, R: F64) -> F64:
    """(3, 3): rows are the table's x, to the camera's right as far as it can be, y and z, which is `up`."""
    x = R[0] - (R[0] @ up) * up
    if np.linalg.norm(x) < 1e-3:  # the camera lies on its side
        x = R[1] - (R[1] @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _attention(points: F64, view: Views) -> F64:
    """(N,) how near to the middle of the picture points are seen, 1 there and 0.6 at 11 degrees from it."""
    x, y, z = (points @ view.R[0].T + view.T[0]).T
    return np.asarray(np.exp(-(x**2 + y**2) / (2 * (_SHARP * z) ** 2)))


def _things(flat: F64, attention: F64, where: object) -> tuple[F64, F64]:
    """The corners (x, y) of the box around the group of things that is looked at most, margin included."""
    try:
        import cv2
    except ImportError as error:
        raise missing_extra("finding a table needs OpenCV", "fuse") from error
    on_table = np.abs(flat[:, 2]) < _NEAR
    corner = flat[on_table, :2].min(axis=0)
    cells = np.floor((flat[:, :2] - corner) / _CELL).astype(np.int64)
    size = cells[on_table].max(axis=0) + 1
    inside = ((cells >= 0) & (cells < size)).all(axis=1)
    table = np.zeros(size[::-1], np.uint8)
    cv2.fillConvexPoly(table, cv2.convexHull(cells[on_table].astype(np.int32)), 1)
    around = np.ones((2 * round(_RIM / _CELL) + 1,) * 2, np.uint8)
    table = np.asarray(cv2.erode(np.pad(table, 1), around)[1:-1, 1:-1])
    x, y = cells[inside & (flat[:, 2] >= _TALLEST)].T
    walls: U8 = np.zeros_like(table)
    walls[y, x] = 1
    table[cv2.dilate(walls, around) > 0] = 0
    rising = inside & (flat[:, 2] > _ABOVE) & (flat[:, 2] < _TALLEST)
    x, y = cells[rising].T
    over = table[y, x] > 0
    found: U8 = np.zeros_like(table)
    found[y[over], x[over]] = 1
    reach = round(_GAP / _CELL)
    _, labels = cv2.connectedComponents(cv2.dilate(found, np.ones((reach + 1, reach + 1), np.uint8)))
    here = labels[y[over], x[over]]
    if not len(here):
        raise OcnfError("nothing stands on the table", code="empty", where=where,
                        expected=f"things of {_ABOVE * 100:g} to {_TALLEST * 100:g} cm above it")
    own: Bool = here == np.bincount(here, attention[rising][over]).argmax()
    places = flat[rising][over][own][:, :2]
    return places.min(axis=0) - _MARGIN, places.max(axis=0) + _MARGIN
