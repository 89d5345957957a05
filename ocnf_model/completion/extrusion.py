"""Visible points grown along the scene's main directions, after Zheng et al. 2013.

Zheng et al. (Beyond Point Clouds: Scene Understanding by Reasoning Geometry and Physics, CVPR 2013, sec. 3)
fill a hidden voxel where visible points of its object lie along the Manhattan directions. Here, without their
segmentation into objects: a voxel is filled if visible points above the table are met along at least
`_AGREE` of five directions: up, and both ways along two horizontal main directions. On the way to a point
all voxels have to be hidden, as a solid's would be. The main directions are those of most horizontal normals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import affine_transform

from ocnf_data.arrays import F64, U8, Bool
from ocnf_data.views.cameras import Views
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST, Visible

_AGREE = 2
_UPRIGHT = 0.5  # a normal whose z is below this in size belongs to the side of a thing
_BINS = 45  # of two degrees each, in a quarter turn


@dataclass(frozen=True, eq=False)
class Sweeps:
    """What is met from each voxel through hidden voxels.

    Attributes:
        above: (D, H, W) bool: whether a visible point lies straight above.
        beside: (D, H, W) uint8: in how many of the four horizontal main directions one does, 0 to 4.
    """

    above: Bool
    beside: U8

    @classmethod
    def of(cls, scene: Tabletop, visible: Visible) -> Sweeps:
        """Grow the visible points of a scene that lie above the table."""
        hidden = visible.in_image & ~visible.free
        points, normals = points_and_normals(scene.view)
        above = points[:, 2] >= LOWEST * scene.voxel
        surface = _voxels_of(points[above], scene)
        up = sweep(surface[::-1], hidden[::-1], 0)[::-1]
        _, height, width = surface.shape
        size = int(np.ceil(np.hypot(height, width)))
        angle = main_direction(normals[above])
        turn = _Turn(angle, (height, width), (size, size))
        source, through = turn(surface.astype(np.uint8)) > 0, turn(hidden.astype(np.uint8)) > 0
        votes = np.zeros(source.shape, np.uint8)
        for axis in (1, 2):
            votes += sweep(source, through, axis)
            votes += np.flip(sweep(np.flip(source, axis), np.flip(through, axis), axis), axis)
        beside = _Turn(-angle, (size, size), (height, width))(votes)
        return cls(up & hidden, np.where(hidden, beside, 0).astype(np.uint8))


def extrude(scene: Tabletop, agree: int = _AGREE) -> Bool:
    """(D, H, W) bool: the visible band, and what is enclosed by visible points in `agree` directions."""
    visible = Visible.of(scene.view, scene.shape, scene.voxel)
    sweeps = Sweeps.of(scene, visible)
    return np.asarray((visible.tsdf < 0) | (sweeps.above + sweeps.beside >= agree))


def sweep(surface: Bool, hidden: Bool, axis: int) -> Bool:
    """Grow `surface` towards higher indices of `axis` through hidden voxels; the surface itself included."""
    source, through = np.moveaxis(surface, axis, 0), np.moveaxis(hidden, axis, 0)
    out = np.empty_like(source)
    reached = np.zeros(source.shape[1:], bool)
    for i in range(len(source)):
        reached = source[i] | (reached & through[i])
        out[i] = reached
    return np.moveaxis(out, 0, axis)


def points_and_normals(view: Views) -> tuple[F64, F64]:
    """World points (N, 3) in metres of the measured pixels, and their unit normals (N, 3), of either sign."""
    depth, K = view.depth[0].astype(np.float64), view.K[0]
    rows, columns = depth.shape
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    measured = (depth > 0) & np.isfinite(depth)
    z = np.where(measured, depth, np.nan)
    camera = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=-1)  # (H, W, 3)
    world = (camera - view.T[0]) @ view.R[0]  # R^T (X_c - T)
    step = 3  # pixels: noise of one pixel's depth would turn the normals about
    across = np.full_like(world, np.nan)
    along = np.full_like(world, np.nan)
    across[:, step:-step] = world[:, 2 * step:] - world[:, : -2 * step]
    along[step:-step] = world[2 * step:] - world[: -2 * step]
    normal = np.cross(across, along)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return world[measured], np.nan_to_num(normal[measured])


def main_direction(normals: F64) -> float:
    """The angle about z in [0, pi/2), radians, of most upright sides' normals, modulo a quarter turn."""
    upright = (np.abs(normals[:, 2]) < _UPRIGHT) & (normals != 0).any(axis=1)
    angles = np.arctan2(normals[upright, 1], normals[upright, 0]) % (np.pi / 2)
    counts = np.bincount((angles / (np.pi / 2) * _BINS).astype(int) % _BINS, minlength=_BINS)
    smooth = counts + np.roll(counts, 1) + np.roll(counts, -1)
    return float((np.argmax(smooth) + 0.5) / _BINS * np.pi / 2)


def _voxels_of(points: F64, scene: Tabletop) -> Bool:
    """The voxels (D, H, W) that hold a point."""
    zyx = np.floor(points[:, ::-1] / scene.voxel).astype(np.int64)
    zyx = zyx[((zyx >= 0) & (zyx < scene.shape)).all(axis=1)]
    out = np.zeros(scene.shape, bool)
    out[tuple(zyx.T)] = True
    return out


class _Turn:
    """A horizontal turn of volumes about their middle, nearest voxel, from one (H, W) to another."""

    def __init__(self, angle: float, before: tuple[int, int], after: tuple[int, int]) -> None:
        c, s = np.cos(angle), np.sin(angle)
        self._matrix = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])  # of (z, y, x): result to operand
        middles = [(np.array([0, *size]) - [0, 1, 1]) / 2 for size in (before, after)]
        self._offset = middles[0] - self._matrix @ middles[1]
        self._after = after

    def __call__(self, volume: U8) -> U8:
        shape = (volume.shape[0], *self._after)
        return np.asarray(affine_transform(volume, self._matrix, self._offset, shape, order=0))
