"""The oracle itself: adjoint operators, weak duality, a linear program, the prox by brute force."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import diags, eye, hstack, kron, vstack

SHAPES = [(4, 5, 6), (1, 7, 3), (2, 2, 2)]


def random_histogram(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """(n, ...) with about half of the bins empty."""
    h = rng.random(shape) ** 3 * (rng.random(shape) < 0.5) + 1e-3
    return h / h.sum(axis=0)


@pytest.mark.parametrize("shape", SHAPES)
def test_divergence_is_minus_the_adjoint_of_the_gradient(oracle: SimpleNamespace, shape: tuple) -> None:
    rng = np.random.default_rng(0)
    u, p = rng.normal(size=shape), rng.normal(size=(3, *shape))
    np.testing.assert_allclose((oracle.gradient(u) * p).sum(), -(u * oracle.divergence(p)).sum())


def test_every_dual_energy_is_below_every_primal_energy(oracle: SimpleNamespace) -> None:
    rng = np.random.default_rng(1)
    h = random_histogram(rng, 10, 4, 3, 5)
    for weight in (0.01, 1, 30):
        for _ in range(20):
            p = rng.normal(size=(3, 4, 3, 5))
            p /= np.maximum(1, np.sqrt((p**2).sum(axis=0)))
            assert oracle.dual(p, h, weight) <= oracle.primal(rng.uniform(-1, 1, (4, 3, 5)), h, weight)


def test_prox_by_brute_force(oracle: SimpleNamespace) -> None:
    rng = np.random.default_rng(2)
    h, v = random_histogram(rng, 10, 200), rng.uniform(-2, 2, 200)
    candidates = np.linspace(-1, 1, 18001)[:, None]
    data = sum(h[j] * abs(candidates - (2 * j / 9 - 1)) for j in range(10))
    for t_weight in (0.05, 0.7, 3):
        best = candidates[np.argmin((candidates - v) ** 2 / 2 + t_weight * data, axis=0), 0]
        np.testing.assert_allclose(oracle.prox(v, h, t_weight), best, atol=1.2e-4)


@pytest.mark.parametrize("weight", [0.1, 0.6, 4.0])
def test_a_line_of_voxels_is_a_linear_program(oracle: SimpleNamespace, weight: float) -> None:
    n, bins = 24, 6
    h = random_histogram(np.random.default_rng(3), bins, n, 1, 1)
    u, _, gaps = oracle.solve(h, weight, 1e-8)
    # Variables: u (n), then |u_i+1 - u_i| (n - 1), then |u_i - l_j| (bins n).
    differences = diags([-np.ones(n - 1), np.ones(n - 1)], [0, 1], shape=(n - 1, n))
    picks = kron(np.ones((bins, 1)), eye(n))
    terms = vstack([differences, picks])
    offsets = np.concatenate([np.zeros(n - 1), np.repeat(np.linspace(-1, 1, bins), n)])
    cost = np.concatenate([np.zeros(n), np.ones(n - 1), weight * h.ravel()])
    bound = vstack([hstack([terms, -eye(terms.shape[0])]), hstack([-terms, -eye(terms.shape[0])])])
    limits = [(-1, 1)] * n + [(0, None)] * terms.shape[0]
    program = linprog(cost, A_ub=bound, b_ub=np.concatenate([offsets, -offsets]), bounds=limits)
    assert gaps[-1] <= 1e-8
    np.testing.assert_allclose(oracle.primal(u, h, weight), program.fun, rtol=1e-7)


def test_the_gap_goes_to_zero(oracle: SimpleNamespace) -> None:
    h = random_histogram(np.random.default_rng(4), 10, 8, 8, 8)
    u, p, gaps = oracle.solve(h, 0.7, 1e-9)
    assert -1e-12 <= gaps[-1] <= 1e-9
    assert abs(u).max() <= 1
    assert (p**2).sum(axis=0).max() <= 1 + 1e-12
