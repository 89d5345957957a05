"""TV-L1 on blocks: the dense problem's solution, whatever the histogram, the weight and the grid."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.meshes import read_mesh
from ocnf_data.octree import GridOctree
from ocnf_model.baselines import minimise, tvl1
from ocnf_model.baselines.blocks import Histogram, State
from ocnf_model.baselines.passes import PrimalStep, Votes, dual_pass, primal_pass
from ocnf_model.metrics import grid_mad_mm

WEIGHTS = [0.1, 0.3, 1.0, 3.0, 10.0]


def random_octree(seed: int, grid: tuple[int, int, int], bins: int = 10) -> GridOctree:
    """Blobs of free and of unseen space, some constant in between, and noise where they meet."""
    rng = np.random.default_rng(seed)
    shape = tuple(8 * n for n in grid)
    z, y, x = np.meshgrid(*[np.arange(n) for n in shape], indexing="ij")
    field = np.zeros(shape)
    for _ in range(4):
        centre, radius = rng.uniform(0, shape), rng.uniform(2, 10)
        distance = np.sqrt(sum((a - c) ** 2 for a, c in zip((z, y, x), centre, strict=True)))
        field = np.maximum(field, 1 - distance / radius)
    noise = rng.random((bins, *shape)) ** 4
    h = noise / noise.sum(axis=0)
    h[:, field == 0] = np.eye(bins)[bins - 1][:, None]
    h[:, field > 0.6] = np.eye(bins)[0][:, None]
    h[:, :8, :8, :8] = np.eye(bins)[rng.integers(bins)][:, None, None, None]
    return GridOctree.from_dense(h.astype(np.float32))


def constant_octree(bin_: int) -> GridOctree:
    """16 x 8 x 24, all votes in one bin."""
    h = np.zeros((10, 16, 8, 24), np.float32)
    h[bin_] = 1
    return GridOctree.from_dense(h)


def dense(octree: GridOctree) -> np.ndarray:
    """float64."""
    return octree.to_dense().astype(np.float64)


@pytest.mark.parametrize("weight", WEIGHTS)
def test_energy_is_that_of_the_dense_oracle(weight: float, oracle: SimpleNamespace, chair32: Any) -> None:
    check_energy(chair32.histogram, weight, oracle)


@pytest.mark.parametrize("weight", WEIGHTS)
def test_the_gap_holds_on_the_dense_volume(weight: float, oracle: SimpleNamespace, sphere32: Any) -> None:
    """Expanded to all voxels, u and p bound the minimum by themselves; 0.1 needs the anchored steps."""
    solution = minimise(sphere32.histogram, weight)
    h, u = dense(sphere32.histogram), dense(solution.values())[0]
    p = np.stack([blocks_to_dense(solution.state.p[:, axis], solution.state.slots) for axis in range(3)])
    assert (p**2).sum(axis=0).max() <= 1 + 1e-6
    energy, bound = oracle.primal(u, h, weight), oracle.dual(p, h, weight)
    assert energy - bound <= 1e-4 * energy
    assert solution.gap == pytest.approx((energy - bound) / energy, abs=2e-6)
    assert solution.state.anchored == (weight == 0.1)


@pytest.mark.parametrize(("category", "weight"), [("chair", 0.3), ("chair", 3.0), ("bed", 0.1), ("bed", 1.0),
                                                  ("bed", 10.0)])
def test_energy_on_real_meshes_at_64(category: str, weight: float, oracle: SimpleNamespace,
                                     scan: Callable[..., Any]) -> None:
    root = os.environ.get("OCNF_DATA")
    if root is None:
        pytest.skip("OCNF_DATA is not set")
    mesh = read_mesh(min((Path(root) / "meshes" / category / "test").iterdir()))
    check_energy(scan(mesh, 64).histogram, weight, oracle)


def check_energy(histogram: GridOctree, weight: float, oracle: SimpleNamespace) -> None:
    """Within 1e-4 of the dense lower bound, and what `Solution` says of itself is true of the volume."""
    h = dense(histogram)
    _, p, _ = oracle.solve(h, weight, 1e-5)
    least = oracle.dual(p, h, weight)  # not above the minimum, whatever the gap
    solution = minimise(histogram, weight)
    expanded = oracle.primal(dense(solution.values())[0], h, weight)
    assert expanded <= least * (1 + 1e-4)
    assert expanded >= least * (1 - 1e-6)
    assert solution.energy == pytest.approx(expanded, rel=1e-6)
    assert -1e-6 < solution.gap < 1e-4


@given(st.integers(0, 2**32), st.tuples(*[st.integers(1, 3)] * 3), st.integers(3, 12),
       st.floats(0.3, 20))
@settings(max_examples=12, deadline=None)
def test_any_histogram_on_any_grid(oracle: SimpleNamespace, seed: int, grid: tuple[int, int, int],
                                   bins: int, weight: float) -> None:
    octree = random_octree(seed, grid, bins)
    h = dense(octree)
    _, p, _ = oracle.solve(h, weight, 1e-5)
    least = oracle.dual(p, h, weight)
    solution = minimise(octree, weight)
    assert oracle.primal(dense(solution.values())[0], h, weight) <= least * (1 + 1.2e-4) + 1e-3


def test_steps_are_those_of_the_dense_volume(oracle: SimpleNamespace) -> None:
    """Over-relaxed steps on blocks against SEMANTICS 6 written out: prox, borders, neighbours, layout."""
    octree = random_octree(5, (2, 3, 2))
    h, weight, t, sigma, relax = dense(octree), 0.8, 0.4, 0.2, 1.7
    state = State(Histogram.from_octree(octree), np.ones((2, 3, 2), bool))
    u, p = blocks_to_dense(state.u, state.slots), np.zeros((3, *h.shape[1:]))
    for _ in range(12):
        primal_pass(state.u, state.over, state.p, state.lower, Votes(state.histogram.h, state.h_row),
                    PrimalStep(np.float32(t), np.float32(weight), np.float32(relax), np.float32(1)),
                    state.anchor_u)
        dual_pass(state.over, state.p, state.upper, np.float32(sigma), np.float32(relax), state.anchor_p,
                  np.float32(1))
        best = oracle.prox(u + t * oracle.divergence(p), h, t * weight)
        moved = p + sigma * oracle.gradient(2 * best - u)
        p += relax * (moved / np.maximum(1, np.sqrt((moved**2).sum(axis=0))) - p)
        u += relax * (best - u)
    np.testing.assert_allclose(blocks_to_dense(state.u, state.slots), u, atol=2e-5)
    for axis in range(3):
        np.testing.assert_allclose(blocks_to_dense(state.p[:, axis], state.slots), p[axis], atol=2e-5)


def blocks_to_dense(rows: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """(blocks, 512) -> (D, H, W) float64; 0 where a block is not stored."""
    gd, gh, gw = slots.shape
    blocks = np.where(slots[..., None] >= 0, rows[slots], 0).reshape(gd, gh, gw, 8, 8, 8)
    return blocks.transpose(0, 3, 1, 4, 2, 5).reshape(8 * gd, 8 * gh, 8 * gw).astype(np.float64)


def test_gap_is_never_negative_and_shrinks(chair32: Any) -> None:
    gaps = [minimise(chair32.histogram, 2.0, iterations, 0).gap for iterations in (1, 10, 40, 160, 640)]
    assert all(gap > -1e-6 for gap in gaps)
    assert all(later < earlier for earlier, later in pairwise(gaps))
    assert gaps[-1] < 1e-5


def test_blocks_far_from_data_are_stored_only_when_needed() -> None:
    """A weak data term lets the surface cross whole blocks; a strong one does not."""
    h = np.zeros((10, 48, 48, 48), np.float32)
    h[9] = 1
    h[:, 16:24, 8:40, 8:40] = np.eye(10, dtype=np.float32)[0][:, None, None, None]  # a plate
    h[9, 19, 20, 20], h[0, 19, 20, 20] = 1, 0
    octree = GridOctree.from_dense(h)
    weak, strong = minimise(octree, 0.05), minimise(octree, 10)
    assert len(State.start(strong.state.histogram).u) == 1
    assert len(strong.state.u) < 10 < len(weak.state.u)
    np.testing.assert_array_equal(weak.values().to_dense(), 1)  # smaller than 1 / weight: wiped out
    plate = np.where(h[0] == 1, np.float32(-1), np.float32(1))
    plate[19, 20, 20] = strong.values().to_dense()[0, 19, 20, 20]
    np.testing.assert_array_equal(strong.values().to_dense()[0], plate)


@pytest.mark.parametrize(("bin_", "value"), [(9, 1), (0, -1), (5, 1 / 8), (8, 7 / 8)])
def test_constant_histograms(bin_: int, value: float) -> None:
    octree = tvl1(constant_octree(bin_), 1.0)
    assert octree.n_leaves == 6
    np.testing.assert_allclose(octree.data, value, atol=1e-7)
    if abs(value) == 1:
        np.testing.assert_array_equal(octree.data, value)


def test_free_and_unseen_stay_exact(sphere64: Any) -> None:
    octree = tvl1(sphere64.histogram, 2.0)
    constant = sphere64.histogram.leaf_width() == 8
    h, u = sphere64.histogram.to_dense(), octree.to_dense()[0]
    free, unseen = constant & (h[9] == 1), constant & (h[0] == 1)
    assert free.any()
    assert unseen.any()
    np.testing.assert_array_equal(u[free], 1)
    np.testing.assert_array_equal(u[unseen], -1)


def test_structure_and_scale(chair32: Any) -> None:
    solution = minimise(chair32.histogram, 2.0)
    distance, published = tvl1(chair32.histogram, 2.0), tvl1(chair32.histogram, 2.0, published=True)
    u = solution.values().to_dense()
    np.testing.assert_array_equal(published.to_dense(), u)
    np.testing.assert_allclose(distance.to_dense(), np.clip(1.125 * u, -1, 1), atol=5e-6)
    for octree in (distance, published):
        GridOctree(octree.trees, octree.data)  # validates
        assert np.array_equal(octree.trees, GridOctree.from_dense(octree.to_dense()).trees)


def test_thread_count_does_not_show(chair32: Any) -> None:
    threads = numba.get_num_threads()
    try:
        results = []
        for n in (1, 2):
            numba.set_num_threads(min(n, numba.config.NUMBA_NUM_THREADS))
            results.append(minimise(chair32.histogram, 1.0))
    finally:
        numba.set_num_threads(threads)
    assert results[0].energy == results[1].energy
    np.testing.assert_array_equal(results[0].values().data, results[1].values().data)


def test_better_than_volfus_on_a_noisy_sphere(sphere64: Any) -> None:
    regularised = grid_mad_mm(tvl1(sphere64.histogram, 2.0), sphere64.truth, sphere64.tau)
    assert regularised < 0.9 * grid_mad_mm(sphere64.volfus, sphere64.truth, sphere64.tau)


@pytest.mark.parametrize(("change", "field"), [
    ({"weight": 0.0}, "weight"), ({"weight": float("nan")}, "weight"), ({"iterations": 0}, "iterations"),
    ({"tolerance": -1.0}, "tolerance"), ({"histogram": "tsdf"}, "histogram"),
    ({"histogram": "unnormalised"}, "histogram"), ({"histogram": "negative"}, "histogram"),
])
def test_bad_arguments(change: dict[str, Any], field: str) -> None:
    good = constant_octree(4)
    bins = np.eye(10, dtype=np.float32)
    bad = {"tsdf": good.with_data(good.data[:, :1]), "unnormalised": good.with_data(good.data * 2),
           "negative": good.with_data(good.data - bins[2] + bins[3])}
    arguments: dict[str, Any] = {"histogram": good, "weight": 1.0, **change}
    if isinstance(arguments["histogram"], str):
        arguments["histogram"] = bad[arguments["histogram"]]
    with pytest.raises(OcnfError) as caught:
        tvl1(**arguments)
    assert caught.value.field == field
