"""How far a point is from the nearest surface, by rendering: what paths of cameras are checked against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.render import render_depth

_SIDE = 24  # pixels of each of the six images about a point: one in 3.75 degrees
_FACES = [([1.0, 0, 0], [0, 0, -1.0]), ([-1.0, 0, 0], [0, 0, -1.0]), ([0, 1.0, 0], [0, 0, -1.0]),
          ([0, -1.0, 0], [0, 0, -1.0]), ([0, 0, 1.0], [1.0, 0, 0]), ([0, 0, -1.0], [1.0, 0, 0])]
"""(where to, down) of each image."""


def clearance(vertices: F64, faces: I64, open_beyond: float = 0.0,
              near: float = 1e-3) -> Callable[[F64], F64]:
    """The function from points (N, 3) to the distance of the nearest surface seen from each, metres (N,).

    Six images to a point, 24 x 24 pixels of 90 degrees each, so that a bar may be missed that is thinner than
    a fifteenth of its distance. `inf` where nothing is seen.

    Args:
        vertices: (N, 3) metres.
        faces: (M, 3).
        open_beyond: metres; a point that sees nothing farther than this is within something, and has no room.
        near: metres; what is nearer than this is not seen.
    """
    turns = np.array([[np.cross(down, ahead), down, ahead] for ahead, down in _FACES])  # (6, 3, 3)
    K = np.array([[_SIDE / 2, 0, (_SIDE - 1) / 2], [0, _SIDE / 2, (_SIDE - 1) / 2], [0, 0, 1]])
    v, u = np.mgrid[:_SIDE, :_SIDE]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)])
    length = np.linalg.norm(rays, axis=0)  # of a ray of depth 1

    def at(points: F64) -> F64:
        R = np.tile(turns, (len(points), 1, 1))
        T = -np.einsum("vij,vj->vi", R, np.repeat(points, len(turns), axis=0))
        depth = render_depth(vertices, faces, K, R, T, (_SIDE, _SIDE), near=near)
        distance = (depth * length).reshape(len(points), -1).astype(np.float64)
        return np.where(distance.max(axis=1) > open_beyond, distance.min(axis=1), 0.0)

    return at
