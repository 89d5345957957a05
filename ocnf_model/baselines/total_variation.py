"""TV-L1 fusion of TSDF histograms (Zach, Pock and Bischof 2007; SEMANTICS 6), the regularised baseline.

Minimises over u in [-1, 1], on all voxels of the grid,

    E(u) = sum |grad u|_2 + weight * sum_j h_j |u - l_j|,      l_j = 2 j / (n - 1) - 1,

with forward differences that are 0 at the far border, by the primal-dual algorithm of Chambolle and Pock
(2011). Its dual is D(p) = -sum G*(div p), |p|_2 <= 1, with G the data term on [-1, 1]; E(u) - D(p) bounds how
far E(u) is from its minimum, and the iteration stops when that bound is small enough.

Over-relaxed steps are fastest on nearly everything, but circle around the solution where a weak data term
lets a large body nearly vanish. When the gap says so, reflected steps take over that are pulled back to an
anchor, less each time (Halpern's iteration), with a new anchor whenever the gap has become much smaller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, I32, I64, U64
from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_data.octree.bits import pack_block
from ocnf_model.baselines.blocks import Histogram, State
from ocnf_model.baselines.passes import FREE, PrimalStep, Votes, dual_pass, energies, primal_pass, touched

_STEP = 1 / math.sqrt(12)
"""sqrt(t sigma); |grad|^2 <= 12 in 3-D, so t sigma <= 1/12 converges."""
_RELAXATION = 1.8
"""Relaxation, below 2; takes about half the iterations of no relaxation (1.0), as measured."""
_CHECK_EVERY = 20
_PATIENCE, _CIRCLING = 400, 1e-2
"""Where the relative gap is still above the second after so many iterations, the anchored ones take over."""
_NEW_ANCHOR = 0.3
"""A new anchor is taken where the gap is this share of the last one's, or after 0.4 of all iterations."""
_ROUNDING = 1e-7
"""The share of the data term's range, per voxel, that float32 can get wrong where the energy is nearly 0."""


@dataclass(frozen=True)
class Solution:
    """A minimiser of the TV-L1 energy, with a bound on its distance from the minimum.

    Attributes:
        state: u and its dual variable, by blocks.
        energy: E(u) over all voxels of the grid.
        gap: (E(u) - D(p)) / E(u), which bounds (E(u) - min E) / E(u); 0 where E(u) is 0. Rounding can make
            it negative by about 1e-8.
        iterations: number of iterations that were run.
    """

    state: State
    energy: float
    gap: float
    iterations: int

    def values(self, scale: float = 1.0) -> GridOctree:
        """`clip(scale * u, -1, 1)`, 1 channel, in the structure that `from_dense` would give it."""
        return _pack(self.state, scale)


def tvl1(histogram: GridOctree, weight: float, iterations: int = 5000, tolerance: float = 5e-5, *,
         published: bool = False) -> GridOctree:
    """The TV-L1 reconstruction of a TSDF histogram.

    Args:
        histogram: n >= 3 channels that are not negative and sum to 1, as of `fuse_histogram`; any grid.
        weight: lambda of the data term, above 0; small is smooth. It belongs to a resolution.
        iterations: upper limit; usually 40 to 400 do.
        tolerance: stop when the relative duality gap is this small, so that the energy is within it.
        published: give u itself, as the published code does. It takes bin centres for distances and so
            shrinks every distance by 8/9: for comparison only.

    Returns:
        TSDF / tau in [-1, 1], 1 channel: bin centre j lies at (n - 1) / (n - 2) * l_j tau (1.125 for 10
        bins), so this is `clip(1.125 u, -1, 1)`. Free and unseen space that nothing reaches stay exactly 1
        and -1.

    Raises:
        OcnfError: no such histogram, or a setting out of range.
    """
    bins = histogram.channels
    scale = 1.0 if published or bins < 3 else (bins - 1) / (bins - 2)
    return minimise(histogram, weight, iterations, tolerance).values(scale)


def minimise(histogram: GridOctree, weight: float, iterations: int = 5000,
             tolerance: float = 5e-5) -> Solution:
    """Minimise the TV-L1 energy; arguments as for `tvl1`. State: at most 39 kB a stored block of 8^3."""
    _check(histogram, weight, iterations, tolerance)
    state = State.start(Histogram.from_octree(histogram))
    energy, gap = _evaluate(state, weight)
    done, anchored_at, at_anchor = 0, 0, gap
    while gap > _allowed(state, energy, weight, tolerance) and done < iterations:
        steps = min(_CHECK_EVERY, iterations - done)
        _iterate(state, weight, steps, done - anchored_at)
        done += steps
        needed = touched(state.u, state.p, state.lower, state.upper)
        if needed.any():
            state = state.grown(needed)
        energy, gap = _evaluate(state, weight)
        if state.anchored:
            renew = gap <= _NEW_ANCHOR * at_anchor or done - anchored_at >= 0.4 * done
        else:
            renew = done >= _PATIENCE and gap > _CIRCLING * energy
        if renew:
            state.drop_anchor()
            anchored_at, at_anchor = done, gap
    return Solution(state, energy, gap / energy if energy > 0 else 0.0, done)


def _iterate(state: State, weight: float, steps: int, since_anchor: int) -> None:
    # Where the data term is weak, u has far to go, and the dual variable does not.
    ratio = min(max(0.2 / weight, 0.3), 3.0)
    t, sigma = np.float32(ratio * _STEP), np.float32(_STEP / ratio)
    votes = Votes(state.histogram.h, state.h_row)
    for step in range(1, steps + 1):
        relax = np.float32(2 if state.anchored else _RELAXATION)
        share = np.float32(1 - 1 / (since_anchor + step + 1) if state.anchored else 1)
        if step == steps:  # a plain step ends inside the constraints, and on exact constants
            relax = share = np.float32(1)
        primal_pass(state.u, state.over, state.p, state.lower, votes,
                    PrimalStep(t, np.float32(weight), relax, share), state.anchor_u)
        dual_pass(state.over, state.p, state.upper, sigma, relax, state.anchor_p, share)


def _evaluate(state: State, weight: float) -> tuple[float, float]:
    """E(u) and E(u) - D(p) over the whole grid: blocks that are not stored add 0 to both."""
    sums = np.zeros((len(state.u), 2))
    votes = Votes(state.histogram.h, state.h_row)
    energies(state.u, state.p, state.lower, state.upper, votes, weight, sums)
    primal, dual = sums.sum(axis=0)
    return float(primal), float(primal - dual)


def _allowed(state: State, energy: float, weight: float, tolerance: float) -> float:
    return tolerance * energy + _ROUNDING * weight * state.u.size


def check_weight(weight: float) -> None:
    """Raise OcnfError unless it can weigh the data term: finite, above 0."""
    if not (math.isfinite(weight) and weight > 0):
        raise OcnfError("not a weight", where="tvl1", field="weight", found=weight, expected="above 0")


def _check(histogram: GridOctree, weight: float, iterations: int, tolerance: float) -> None:
    if histogram.channels < 3:
        raise OcnfError("not a TSDF histogram", where="tvl1", field="histogram", expected="3 or more bins",
                        found=f"{histogram.channels} channels")
    if histogram.data.min() < 0 or np.abs(histogram.data.sum(axis=1) - 1).max() > 1e-3:
        raise OcnfError("not a TSDF histogram", where="tvl1", field="histogram",
                        found=f"a smallest bin of {histogram.data.min()}, sums from "
                              f"{histogram.data.sum(axis=1).min()} to {histogram.data.sum(axis=1).max()}",
                        expected="bins that are not negative and sum to 1")
    check_weight(weight)
    if iterations < 1:
        raise OcnfError("no iterations", where="tvl1", field="iterations", found=iterations,
                        expected="1 or more")
    if not tolerance >= 0:
        raise OcnfError("not a tolerance", where="tvl1", field="tolerance", found=tolerance,
                        expected="0 or more")


def _pack(state: State, scale: float) -> GridOctree:
    slots = state.slots.reshape(-1)
    values = np.clip(state.u * np.float32(scale), np.float32(-1), np.float32(1))
    constants = [1.0 if slot == FREE else -1.0 for slot in np.unique(slots[slots < 0])]
    low = min([*constants, *values.min(axis=1, initial=1).min(initial=1, keepdims=True).tolist()])
    high = max([*constants, *values.max(axis=1, initial=-1).max(initial=-1, keepdims=True).tolist()])
    trees = np.zeros((len(slots), 2), np.uint64)
    counts = np.ones(len(slots), np.int64)
    _pack_trees(slots, values, 1e-6 * (high - low), trees, counts)
    prefix = np.concatenate([[0], np.cumsum(counts)])
    data = np.empty((prefix[-1], 1), np.float32)
    _place_leaves(slots, values, prefix, data)
    return GridOctree.trusted(trees.reshape(*state.slots.shape, 2), data)


@njit(cache=True, nogil=True, parallel=True)
def _pack_trees(slots: I32, values: F32, tolerance: float,
                trees: U64, counts: I64) -> None:
    """Structure and leaves of each tree; a stored block's leaves overwrite the front of its values."""
    for tree in prange(len(slots)):
        if slots[tree] < 0:
            continue
        leaves = np.empty((512, 1), np.float32)
        block = values[slots[tree]]
        lo, hi, n = pack_block(block.reshape((8, 8, 8, 1)), tolerance, leaves)
        trees[tree, 0], trees[tree, 1], counts[tree] = lo, hi, n
        block[:n] = leaves[:n, 0]


@njit(cache=True, nogil=True, parallel=True)
def _place_leaves(slots: I32, values: F32, prefix: I64,
                  data: F32) -> None:
    for tree in prange(len(slots)):
        if slots[tree] >= 0:
            data[prefix[tree] : prefix[tree + 1], 0] = values[slots[tree], : prefix[tree + 1] - prefix[tree]]
        else:
            data[prefix[tree], 0] = 1 if slots[tree] == FREE else -1
