"""Synthetic tabletops as frames: procedural scenes seen once by a simulated Kinect, with their ground truth.

The ground truth is fused from noise-free views around the scene, as that of real scenes is from all frames
of a sequence: what no view sees, the insides of things, is not known.
"""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F32, F64
from ocnf_data.fusion import fuse_tsdf
from ocnf_data.render import render_depth
from ocnf_data.scenes import make_scene
from ocnf_data.views.cameras import Views
from ocnf_data.views.rigs import intrinsics
from ocnf_data.views.sensor import add_sensor_noise, sensor_draws
from ocnf_data.views.trajectories import path_around
from ocnf_model.completion.padding import grid_placement, padded_shape
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST, TRUNCATION

VIEWS_PER_SCENE = 3
_VOXEL = 0.005  # metres, as in Voxlets
_DEPTH = 80  # voxels
_MARGIN = 0.15  # metres of the grid around what stands on the table
_LARGEST = 184  # voxels along an axis of the base
_TRUTH_VIEWS = 48
_SIZE, _FOCAL = (480, 640), 573.679  # of Voxlets' camera
_RADIUS = 1.0  # metres from the table's middle


def synthetic_tabletops(seed: int, index: int, views: int = VIEWS_PER_SCENE) -> list[Tabletop]:
    """Frames of the scene of that number, a pure function of the arguments.

    Args:
        seed: seed of scenes, paths and noise.
        index: number of the scene.
        views: number of frames.
    """
    key = f"tabletop-{index}"
    mesh = make_scene("tabletops", seed, index, "train")
    vertices, shape = _in_grid(mesh.vertices)
    middle = np.array([shape[2], shape[1], 0]) * _VOXEL / 2
    K, (height, width) = intrinsics(_FOCAL, _FOCAL, _SIZE[1] / 2, _SIZE[0] / 2), _SIZE

    R, T = path_around(_TRUTH_VIEWS, seed, f"{key}-truth", middle.tolist(), _RADIUS)
    small = K / 2
    small[2, 2] = 1
    depth = render_depth(vertices, mesh.faces, small, R, T, (height // 2, width // 2))
    tsdf = _fused(Views(depth, small, R, T), shape)

    R, T = path_around(views, seed, f"{key}-seen", middle.tolist(), _RADIUS)
    clean = render_depth(vertices, mesh.faces, K, R, T, _SIZE)
    frames = []
    for i in range(views):
        noisy = add_sensor_noise(clean[i], K, sensor_draws(seed, key, i, _SIZE))
        view = Views(noisy[None], K, R[i: i + 1], T[i: i + 1])
        frames.append(Tabletop(frame_name(seed, index, i), view, _VOXEL, tsdf))
    return frames


def frame_name(seed: int, index: int, view: int) -> str:
    """The name of a frame, which says all that it depends on."""
    return f"synthetic-{seed}/tabletop-{index}/{view}"


def _in_grid(vertices: F64) -> tuple[F64, tuple[int, int, int]]:
    """The vertices with the table's top just below what is judged, and the grid's shape around the things."""
    things = vertices[vertices[:, 2] > 1e-4]
    low, high = things[:, :2].min(axis=0) - _MARGIN, things[:, :2].max(axis=0) + _MARGIN
    size = np.minimum(np.ceil((high - low) / _VOXEL).astype(int), _LARGEST)
    corner = (low + high) / 2 - size * _VOXEL / 2
    moved = vertices - [*corner, -(LOWEST - 1) * _VOXEL]
    return moved, (_DEPTH, int(size[1]), int(size[0]))


def _fused(views: Views, shape: tuple[int, int, int]) -> F32:
    """(D, H, W) metres, NaN where no view saw anything."""
    whole = padded_shape(shape)
    extent, centre = grid_placement(whole, _VOXEL)
    values = fuse_tsdf(views, whole, extent, TRUNCATION, centre=centre).to_dense()[0]
    depth, height, width = shape
    values = values[:depth, :height, :width]
    return np.where(values == -1, np.nan, values * TRUNCATION).astype(np.float32)
