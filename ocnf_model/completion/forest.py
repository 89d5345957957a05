"""Voxlets: a structured forest that predicts the occupancy around visible points, after Firman et al. 2016.

Firman et al. (Structured Prediction of Unobserved Voxels From a Single Depth Image, CVPR 2016) place boxes of
voxels at visible points, upright and turned with the surface; a forest gives each box its occupancy from
features of the depth around its point, and the boxes that overlap are averaged with weights. Simplified here:

- The leaves hold coefficients of a PCA of the boxes, averaged (a regression forest of scikit-learn), where
  theirs cluster the coefficients at each split and hold one example, a medoid.
- One size of box, 20 x 15 cm and from the table up to 32 cm, with voxels of 10 mm; theirs are two sizes.
- Features are differences of depth at fixed offsets around the point, its height and its normal, where
  theirs are distances to the nearest surface along compass rays, and a sampled shape descriptor.
- A box's weight falls with the disagreement of the trees; theirs are chosen by an energy that also compares
  the boxes with the visible surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ocnf_data.arrays import F32, F64, I64, U8
from ocnf_data.errors import missing_extra
from ocnf_data.views.cameras import Views
from ocnf_model.completion.extrusion import points_and_normals
from ocnf_model.completion.padding import padded_shape
from ocnf_model.completion.sample import SHRINK, finer
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST

_CELL = 0.01  # metres
_AHEAD, _BACK, _ACROSS, _UP = 15, 5, 15, 30  # cells of a box: into the thing, out of it, across, upwards
_COMPONENTS = 40
_TREES, _LEAF = 24, 8
_PER_FRAME = 100  # points to train on
_PLACED = 500  # points of a frame that boxes are placed at
_RADII, _ANGLES = (0.01, 0.025, 0.05, 0.1, 0.2), 8  # metres and number of the depth features' offsets
_FAR = 0.3  # metres: larger differences of depth are cut, and no measurement is one


@dataclass(frozen=True, eq=False)
class Anchors:
    """Visible points above the table, and what is known there.

    Attributes:
        points: (N, 3) world metres.
        inward: (N, 2) horizontal unit directions into the surface, or away from the camera where it is level.
        features: (N, F) float32.
    """

    points: F64
    inward: F64
    features: F32

    @classmethod
    def of(cls, scene: Tabletop, n: int, seed: int) -> Anchors:
        """Draw up to n visible points of a scene."""
        view = scene.view
        points, normals = points_and_normals(view)
        depth = view.depth[0]
        rows, columns = np.nonzero((depth > 0) & np.isfinite(depth))
        depth_extent = np.array(scene.shape[::-1]) * scene.voxel
        fits = (points[:, 2] >= LOWEST * scene.voxel) & (points[:, :2] > 0).all(axis=1) \
            & (points[:, :2] < depth_extent[:2]).all(axis=1) & (points[:, 2] < _UP * _CELL + 0.03)
        index = np.flatnonzero(fits)
        chosen = np.sort(np.random.default_rng(seed).permutation(index)[:n])
        points, normals = points[chosen], normals[chosen]
        rays = points - (-view.R[0].T @ view.T[0])
        into = np.where(((normals * rays).sum(axis=1) < 0)[:, None], -normals, normals)
        level = np.linalg.norm(into[:, :2], axis=1) < 0.3  # the top of a thing
        inward = np.where(level[:, None], rays[:, :2], into[:, :2])
        inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-9)
        around = _depth_differences(view, rows[chosen], columns[chosen])
        own = np.column_stack([points[:, 2], np.abs(into[:, 2]), level, _cosine(inward, rays)])
        return cls(points, inward, np.column_stack([around, own]).astype(np.float32))

    def cells(self, scene: Tabletop) -> F64:
        """World positions (N, cells, 3), metres, of the cells of each point's box."""
        ahead = (np.arange(-_BACK, _AHEAD) + 0.5) * _CELL
        across = (np.arange(_ACROSS) + 0.5 - _ACROSS / 2) * _CELL
        up = LOWEST * scene.voxel + (np.arange(_UP) + 0.5) * _CELL
        z, a, b = (grid.reshape(-1) for grid in np.meshgrid(up, ahead, across, indexing="ij"))
        side = np.column_stack([-self.inward[:, 1], self.inward[:, 0]])
        xy = self.points[:, None, :2] + a[:, None] * self.inward[:, None] + b[:, None] * side[:, None]
        return np.concatenate([xy, np.broadcast_to(z[:, None], (*xy.shape[:2], 1))], axis=2)


class StructuredForest:
    """The forest, fitted to frames with ground truth.

    Args:
        scenes: the frames.
        seed: seed of points, PCA and forest.

    Raises:
        OcnfError: scikit-learn is not installed (code `missing_extra`).
    """

    def __init__(self, scenes: Sequence[Tabletop], seed: int = 0) -> None:
        try:
            from sklearn.decomposition import PCA
            from sklearn.ensemble import RandomForestRegressor
        except ModuleNotFoundError as error:
            raise missing_extra("the structured forest needs scikit-learn", "completion") from error
        features, boxes = [], []
        for i, scene in enumerate(scenes):
            anchors = Anchors.of(scene, _PER_FRAME, seed + i)
            if len(anchors.points):
                features.append(anchors.features)
                boxes.append(_look_up(scene.occupied.astype(np.uint8), anchors.cells(scene), scene.voxel))
        patches = np.concatenate(boxes).astype(np.float32)
        self._pca: Any = PCA(min(_COMPONENTS, *patches.shape), svd_solver="randomized", random_state=seed)
        coefficients = self._pca.fit_transform(patches)
        self._forest: Any = RandomForestRegressor(_TREES, min_samples_leaf=_LEAF, max_features="sqrt",
                                                  random_state=seed, n_jobs=1)
        self._forest.fit(np.concatenate(features), coefficients)
        self._seed = seed

    def probability(self, scene: Tabletop) -> F32:
        """(D, H, W) in [0, 1]: the weighted average of the boxes; 0 where none lies."""
        anchors = Anchors.of(scene, _PLACED, self._seed)
        depth, height, width = (n // SHRINK for n in padded_shape(scene.shape, SHRINK))
        if not len(anchors.points):
            return np.zeros(scene.shape, np.float32)
        trees = np.stack([tree.predict(anchors.features) for tree in self._forest.estimators_])
        spread = np.sqrt(trees.var(axis=0).sum(axis=1))  # (N,)
        weight = 1 / (spread + 0.1 * spread.mean() + 1e-6)
        boxes = np.clip(self._pca.inverse_transform(trees.mean(axis=0)), 0, 1)  # (N, cells)
        zyx = np.floor(anchors.cells(scene)[..., ::-1] / (SHRINK * scene.voxel)).astype(np.int64)
        inside = ((zyx >= 0) & (zyx < [depth, height, width])).all(axis=2)
        flat = np.ravel_multi_index(tuple(np.moveaxis(zyx[inside], -1, 0)), (depth, height, width))
        weights = np.broadcast_to(weight[:, None], inside.shape)[inside]
        total = np.bincount(flat, weights, depth * height * width)
        occupied = np.bincount(flat, weights * boxes[inside], depth * height * width)
        mean = (occupied / np.maximum(total, 1e-12)).astype(np.float32).reshape(depth, height, width)
        return finer(mean, scene.shape)


def _depth_differences(view: Views, rows: I64, columns: I64) -> F64:
    """(N, radii x angles) metres: depth at offsets of fixed lengths in the world, minus the point's own."""
    depth, focal = view.depth[0], float(view.K[0, 0, 0])
    own = depth[rows, columns].astype(np.float64)
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    out = np.empty((len(rows), len(_RADII), _ANGLES))
    for i, radius in enumerate(_RADII):
        reach = radius * focal / own
        v = np.rint(rows[:, None] + reach[:, None] * np.sin(angle)).astype(np.int64)
        u = np.rint(columns[:, None] + reach[:, None] * np.cos(angle)).astype(np.int64)
        inside = (v >= 0) & (v < depth.shape[0]) & (u >= 0) & (u < depth.shape[1])
        other = depth[np.clip(v, 0, depth.shape[0] - 1), np.clip(u, 0, depth.shape[1] - 1)]
        difference = np.clip(np.where(np.isfinite(other), other, 1e3) - own[:, None], -_FAR, _FAR)
        out[:, i] = np.where(inside & (other > 0), difference, _FAR)
    return out.reshape(len(rows), -1)


def _cosine(inward: F64, rays: F64) -> F64:
    """How straight the surface is looked at, from above."""
    flat = rays[:, :2] / np.maximum(np.linalg.norm(rays[:, :2], axis=1, keepdims=True), 1e-9)
    return np.asarray((inward * flat).sum(axis=1))


def _look_up(volume: U8, cells: F64, voxel: float) -> U8:
    """Values (N, cells) of a (D, H, W) volume; 0 outside of it."""
    zyx = np.floor(cells[..., ::-1] / voxel).astype(np.int64)
    inside = np.asarray(((zyx >= 0) & (zyx < volume.shape)).all(axis=2))
    z, y, x = np.moveaxis(np.where(inside[..., None], zyx, 0), -1, 0)
    return np.where(inside, volume[z, y, x], 0).astype(np.uint8)
