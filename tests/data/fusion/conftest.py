"""The dense float64 oracle of SEMANTICS 2, and scenes to hold fusion against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from ocnf_data.arrays import F64, Bool
from ocnf_data.encodings import Encoding
from ocnf_data.views.cameras import Views

TIE = 1e-8


@dataclass(frozen=True)
class Dense:
    """Expected volumes and where they hang on a rounding tie."""

    values: dict[Encoding, F64]  # each (C, D, H, W)
    tie: Bool  # (D, H, W): a projection, z or distance within TIE of a jump


def dense_fusion(views: Views, shape: tuple[int, int, int], extent: float = 3.0,
                 truncation: float | None = None, threshold: float | None = None,
                 centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Dense:
    """SEMANTICS 2 line by line in plain numpy, all four encodings."""
    voxel = extent / max(shape)
    tau = 0.025 * 256 / 3.0 * voxel if truncation is None else truncation
    threshold = voxel if threshold is None else threshold
    axes = [(np.arange(n) + 0.5) * voxel - n * voxel / 2 for n in shape]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    points = np.stack([x, y, z], axis=-1) + np.array(centre)
    height, width = views.size

    total, count = np.zeros(shape), np.zeros(shape)
    votes = np.zeros((10, *shape))
    free = np.zeros(shape, bool)
    tie = np.zeros(shape, bool)
    centres = np.linspace(-tau - tau / 8, tau + tau / 8, 10)
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        Xc = points @ R.T + T
        zc = Xc[..., 2]
        in_front = zc > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            u_half = K[0, 0] * Xc[..., 0] / zc + K[0, 2] + 0.5
            v_half = K[1, 1] * Xc[..., 1] / zc + K[1, 2] + 0.5
        u = np.floor(np.where(in_front, u_half, -1.0))
        v = np.floor(np.where(in_front, v_half, -1.0))
        inside = in_front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        d = np.zeros(shape)
        d[inside] = depth[v[inside].astype(int), u[inside].astype(int)]
        measured = inside & (d > 0)
        dist = np.where(measured, d - zc, -np.inf)

        valid = dist >= -tau
        total += np.where(valid, np.minimum(dist, tau), 0.0)
        count += valid
        free |= dist > threshold
        for j in range(10):  # the hat function of centre j, flat beyond the two end centres
            share = np.interp(dist, centres, np.eye(10)[j])
            votes[j] += np.where(valid, share, 0.0)

        near_jump = np.abs(dist + tau) < TIE
        near_jump |= np.abs(dist - threshold) < TIE
        for half in (u_half, v_half):
            near_jump |= in_front & (np.abs(half - np.round(half)) < TIE * (1 + np.abs(half)))
        tie |= near_jump | (np.abs(zc) < TIE)

    seen = count > 0
    n = np.maximum(count, 1)
    tsdf = np.where(seen, total / n / tau, -1.0)
    histogram = np.where(seen, votes / n, np.eye(10)[0].reshape(10, 1, 1, 1))
    values = {
        Encoding.TSDF: tsdf[None],
        Encoding.TDF_OCCUPANCY: np.stack([np.abs(tsdf), tsdf < 0]),
        Encoding.HISTOGRAM: histogram,
        Encoding.OCCUPANCY: np.where(free, 0.0, 1.0)[None],
    }
    return Dense(values, tie)


@pytest.fixture(scope="session")
def oracle() -> Callable[..., Dense]:
    """`dense_fusion`, tested itself in test_oracle.py."""
    return dense_fusion


def orbit(n: int, distance: float, seed: int = 0) -> tuple[F64, F64]:
    """Random cameras looking at the origin: (R (n, 3, 3), T (n, 3))."""
    rng = np.random.default_rng(seed)
    R, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    R[np.linalg.det(R) < 0] *= -1
    return R, np.tile([0.0, 0.0, distance], (n, 1))


def cast(hit: Callable[[F64, F64], F64], K: F64, R: F64, T: F64, size: tuple[int, int]) -> Views:
    """Exact depth maps of an analytic body.

    `hit(origin (3,), directions (..., 3))` gives the ray parameter of the first hit, inf for none; the
    directions have z_c = 1, so that the parameter is the depth.
    """
    v, u = np.indices(size, dtype=np.float64)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(size)], axis=-1)
    depth = np.stack([hit(-r.T @ t, rays @ r) for r, t in zip(R, T, strict=True)])
    return Views(depth.astype(np.float32), K, R, T)


@pytest.fixture(scope="session")
def scenes() -> dict[str, Views]:
    """Analytic bodies seen by 12 non-square, off-centre cameras with fx != fy."""

    def sphere(o: F64, d: F64) -> F64:
        a, b, c = (d * d).sum(-1), (d @ o), o @ o - 1.0
        with np.errstate(invalid="ignore"):
            t = (-b - np.sqrt(b * b - a * c)) / a
        return np.where(np.isnan(t), np.inf, t)

    def box(o: F64, d: F64) -> F64:
        half = np.array([0.9, 0.6, 0.4])
        with np.errstate(divide="ignore", invalid="ignore"):
            t0, t1 = (-half - o) / d, (half - o) / d
        enter, leave = np.minimum(t0, t1).max(-1), np.maximum(t0, t1).min(-1)
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)

    def plane(o: F64, d: F64) -> F64:
        normal, offset = np.array([0.6, 0.0, 0.8]), 0.1
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (offset - o @ normal) / (d @ normal)
        return np.where(t > 0, t, np.inf)

    K = np.array([[151.0, 0, 113.3], [0, 173.0, 80.9], [0, 0, 1]])
    R, T = orbit(12, 3.2)
    size = (170, 220)
    return {"sphere": cast(sphere, K, R, T, size), "box": cast(box, K, R, T, size),
            "plane": cast(plane, K, R, T, size)}
