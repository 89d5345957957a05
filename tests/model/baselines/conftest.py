"""A dense float64 TV-L1 solver as the oracle, and inputs to compare on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from numba import njit, prange

from ocnf_data.arrays import F64
from ocnf_data.fusion import DepthPyramid, default_truncation, fuse_histogram, fuse_tsdf
from ocnf_data.meshes import Mesh, normalise
from ocnf_data.octree import GridOctree
from ocnf_data.render import render_depth
from ocnf_data.shapes import make_shape
from ocnf_data.views.cameras import Views
from ocnf_data.views.noise import add_noise, view_noise
from ocnf_data.views.rigs import intrinsics, look_from, published80, view_subset


def gradient(u: F64) -> F64:
    """Forward differences (3, D, H, W), 0 at the far border."""
    return np.stack([np.diff(u, axis=axis, append=np.take(u, [-1], axis)) for axis in range(3)])


def divergence(p: F64) -> F64:
    """Backward differences, summed; p is 0 before the near border and on the far one."""
    total = np.zeros(p.shape[1:])
    for axis in range(3):
        inside = np.moveaxis(p[axis].copy(), axis, 0)
        inside[-1] = 0
        total += np.moveaxis(np.diff(inside, axis=0, prepend=np.zeros_like(inside[:1])), 0, axis)
    return total


def primal_energy(u: F64, h: F64, weight: float) -> float:
    """E(u) of (D, H, W), h being (n, D, H, W)."""
    centres = np.linspace(-1, 1, len(h))
    data = sum((share * abs(u - centre)).sum() for share, centre in zip(h, centres, strict=True))
    return float(np.sqrt((gradient(u) ** 2).sum(axis=0)).sum() + weight * data)


def dual_energy(p: F64, h: F64, weight: float) -> float:
    """-sum G*(div p), the maximum of the conjugate taken over all breakpoints, each evaluated in full."""
    centres = np.linspace(-1, 1, len(h))
    q, best = divergence(p), np.full(h.shape[1:], -np.inf)
    for at in centres:
        cost = sum(share * abs(at - centre) for share, centre in zip(h, centres, strict=True))
        best = np.maximum(best, q * at - weight * cost)
    return -float(best.sum())


def prox(v: F64, h: F64, t_weight: float) -> F64:
    """SEMANTICS 6: the clamped median of the breakpoints and of v + t weight W_i."""
    n = len(h)
    below = np.concatenate([np.zeros_like(h[:1]), np.cumsum(h, axis=0)])
    moved = v + t_weight * (h.sum(axis=0) - 2 * below)  # (n + 1, ...)
    centres = np.broadcast_to(np.linspace(-1, 1, n).reshape(-1, *[1] * v.ndim), h.shape)
    return np.clip(np.median(np.concatenate([centres, moved]), axis=0), -1, 1)


@njit(parallel=True)
def _primal_step(u: F64, over: F64, p: F64, h: F64, t: float, weight: float, relax: float) -> None:
    n, depth, height, width = h.shape
    for z in prange(depth):
        for y in range(height):
            for x in range(width):
                q = p[0, z, y, x] + p[1, z, y, x] + p[2, z, y, x]
                q -= (p[0, z - 1, y, x] if z else 0) + (p[1, z, y - 1, x] if y else 0)
                q -= p[2, z, y, x - 1] if x else 0
                v = u[z, y, x] + t * q
                # Walk up the bins while the derivative of the prox's objective is still negative.
                slope, best = 1.0, -2.0
                for j in range(n):
                    if best < -1.5 and v + t * weight * slope <= 2 * j / (n - 1) - 1:
                        best = v + t * weight * slope
                    slope -= 2 * h[j, z, y, x]
                    if best < -1.5 and v + t * weight * slope <= 2 * j / (n - 1) - 1:
                        best = 2 * j / (n - 1) - 1
                    if best > -1.5:
                        break
                    if j == n - 1:
                        best = v + t * weight * slope
                best = min(max(best, -1.0), 1.0)
                over[z, y, x] = 2 * best - u[z, y, x]
                u[z, y, x] += relax * (best - u[z, y, x])


@njit(parallel=True)
def _dual_step(over: F64, p: F64, sigma: float, relax: float) -> None:
    depth, height, width = over.shape
    for z in prange(depth):
        for y in range(height):
            for x in range(width):
                here = over[z, y, x]
                a = p[0, z, y, x] + sigma * (over[min(z + 1, depth - 1), y, x] - here)
                b = p[1, z, y, x] + sigma * (over[z, min(y + 1, height - 1), x] - here)
                c = p[2, z, y, x] + sigma * (over[z, y, min(x + 1, width - 1)] - here)
                norm = max(1.0, np.sqrt(a * a + b * b + c * c))
                p[0, z, y, x] += relax * (a / norm - p[0, z, y, x])
                p[1, z, y, x] += relax * (b / norm - p[1, z, y, x])
                p[2, z, y, x] += relax * (c / norm - p[2, z, y, x])


def solve(h: F64, weight: float, gap: float, limit: int = 20000) -> tuple[F64, F64, list[float]]:
    """u, p and the relative gap every 100 iterations, until it is at most `gap`.

    Every voxel from the first iteration to the last, no blocks. `limit` is a failure, not an answer.
    """
    u = np.tensordot(np.linspace(-1, 1, len(h)), h, 1)
    over, p, gaps = u.copy(), np.zeros((3, *u.shape)), []
    ratio = min(max(0.2 / weight, 0.3), 3)
    t, sigma = ratio / np.sqrt(12), 1 / np.sqrt(12) / ratio
    for done in range(1, limit + 1):
        relax = 1.0 if done % 100 == 0 else 1.8
        _primal_step(u, over, p, h, t, weight, relax)
        _dual_step(over, p, sigma, relax)
        if done % 100 == 0:
            energy = primal_energy(u, h, weight)
            gaps.append((energy - dual_energy(p, h, weight)) / max(energy, 1e-6))
            if gaps[-1] <= gap:
                return u, p, gaps
    raise AssertionError(f"the oracle has not converged: gap {gaps[-1]}")


@pytest.fixture(scope="session")
def oracle() -> SimpleNamespace:
    """The functions above."""
    return SimpleNamespace(gradient=gradient, divergence=divergence, primal=primal_energy, dual=dual_energy,
                           prox=prox, solve=solve)


@dataclass(frozen=True)
class Scan:
    """A model: the histogram and TSDF of 4 views with 2 % noise, and the TSDF of 80 without."""

    histogram: GridOctree
    volfus: GridOctree
    truth: GridOctree
    tau: float

    def dense_histogram(self) -> F64:
        """(n, D, H, W)."""
        return self.histogram.to_dense().astype(np.float64)


def scan_of(mesh: Mesh, resolution: int) -> Scan:
    """Seen from 4 and from 80 of the published directions."""
    vertices, _ = normalise(mesh)
    K = intrinsics(351, 351, 320, 240)
    R, T = look_from(published80(), 3.0)
    clean = Views(render_depth(vertices, mesh.faces, K, R, T, (480, 640)), K, R, T)
    indices = view_subset(80, 4)
    seen = clean.subset(indices)
    noisy = [add_noise(depth, 0.02, view_noise(0, "tvl1", int(view), seen.size))
             for view, depth in zip(indices, seen.depth, strict=True)]
    pyramid = DepthPyramid(seen.with_depth(np.stack(noisy)))
    return Scan(fuse_histogram(pyramid, resolution), fuse_tsdf(pyramid, resolution),
                fuse_tsdf(clean, resolution), default_truncation(resolution))


@pytest.fixture(scope="session")
def scan() -> Callable[[Mesh, int], Scan]:
    """`scan_of`."""
    return scan_of


@pytest.fixture(scope="session")
def chair32() -> Scan:
    """A procedural chair at 32^3."""
    return scan_of(make_shape("chair", 0, 0, "test"), 32)


@pytest.fixture(scope="session")
def sphere64() -> Scan:
    """A sphere at 64^3."""
    return scan_of(_sphere(), 64)


@pytest.fixture(scope="session")
def sphere32() -> Scan:
    """The same at 32^3."""
    return scan_of(_sphere(), 32)


def _sphere() -> Mesh:
    sphere = trimesh.creation.icosphere(4)
    return Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces, np.int64), "", {})
