"""The two half steps of the primal-dual iteration, and its duality gap, on blocks of 8^3 voxels.

All arrays hold one row a block; a row's 512 voxels run z, y, x with x fastest. Components of p and columns of
the neighbour tables are in the order z, y, x. A neighbour is a row, or FREE or UNSEEN for a block that is not
stored because u is constant there and p zero, or OUTSIDE the grid. Every block is computed by itself and sums
are added up in the order of the blocks, so results do not depend on the number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, F64, I32, Bool

FREE, UNSEEN, OUTSIDE = -1, -2, -3


class Votes(NamedTuple):
    """The histogram: `bins` (rows, n, 512), and (blocks,) the row of each block."""

    bins: F32
    row: I32


class PrimalStep(NamedTuple):
    """Step length t, the data term's weight, relaxation, and the share that the anchor does not keep."""

    t: np.float32
    weight: np.float32
    relax: np.float32
    share: np.float32


@njit(cache=True, nogil=True)
def _divergence(p: F32, lower: I32, b: int, q: F32, shifted: F32) -> None:
    """Write div p of block b to q (512,): p minus its lower neighbour, over the axes; 0 beyond the grid."""
    q[:] = 0
    for axis in range(3):
        own = p[b, axis]
        stride = 64 if axis == 0 else 8 if axis == 1 else 1
        shifted[stride:] = own[: 512 - stride]
        _put_face(p[:, axis], lower[b, axis], 0, 7, np.float32(0), axis, shifted)
        for i in range(512):
            q[i] += own[i] - shifted[i]


@njit(cache=True, nogil=True)
def _put_face(values: F32, source: int, to: int, of: int, otherwise: np.float32, axis: int, out: F32) -> None:
    """Layer `to` along the axis := layer `of` of row `source`, or a constant where that is not stored."""
    stride = 64 if axis == 0 else 8 if axis == 1 else 1
    outer, inner = (1, 64) if axis == 0 else (8, 8) if axis == 1 else (64, 1)
    for o in range(outer):
        start = o * 8 * stride
        for i in range(inner):
            at = start + i
            out[at + to * stride] = values[source, at + of * stride] if source >= 0 else otherwise


@njit(cache=True, nogil=True)
def _forward(u: F32, upper: I32, b: int, axis: int, shifted: F32) -> None:
    """The upper neighbour's u of every voxel of block b to shifted (512,); its own beyond the grid."""
    stride = 64 if axis == 0 else 8 if axis == 1 else 1
    own, source = u[b], upper[b, axis]
    shifted[: 512 - stride] = own[stride:]
    if source == OUTSIDE:
        _put_face(u, b, 7, 7, np.float32(0), axis, shifted)
    else:
        _put_face(u, source, 7, 0, np.float32(1 if source == FREE else -1), axis, shifted)


@njit(cache=True, nogil=True, parallel=True)
def primal_pass(u: F32, over: F32, p: F32, lower: I32, votes: Votes, step: PrimalStep, anchor: F32) -> None:
    """u~ = prox(u + t div p); over = 2 u~ - u; u += relax (u~ - u); then u := anchor + share (u - anchor)."""
    t, weight, relax, share = step
    h, h_row = votes
    n = h.shape[1]
    pull = np.float32(2) * t * weight
    for b in prange(len(u)):
        start = anchor[b]
        w, shifted = np.empty(512, np.float32), np.empty(512, np.float32)
        _divergence(p, lower, b, w, shifted)
        own = u[b]
        for i in range(512):
            w[i] = own[i] + t * w[i] + t * weight
        for j in range(n):
            vote, centre = h[h_row[b], j], np.float32(2 * j / (n - 1) - 1)
            for i in range(512):
                low = w[i] - pull * vote[i]
                low = low if low > centre else centre
                w[i] = low if low < w[i] else w[i]
        twice = over[b]
        for i in range(512):
            best = w[i] if w[i] < np.float32(1) else np.float32(1)
            best = best if best > np.float32(-1) else np.float32(-1)
            twice[i] = np.float32(2) * best - own[i]
            own[i] += relax * (best - own[i])
        if share < 1:
            for i in range(512):
                own[i] = start[i] + share * (own[i] - start[i])


@njit(cache=True, nogil=True, parallel=True)
def dual_pass(over: F32, p: F32, upper: I32, sigma: np.float32, relax: np.float32, anchor: F32,
              share: np.float32) -> None:
    """p~ = project(p + sigma grad over) onto |p| <= 1; p += relax (p~ - p); then the same as for u."""
    for b in prange(len(p)):
        shifted, step = np.empty(512, np.float32), np.empty((3, 512), np.float32)
        norm, own = np.zeros(512, np.float32), over[b]
        for axis in range(3):
            _forward(over, upper, b, axis, shifted)
            old, new = p[b, axis], step[axis]
            for i in range(512):
                moved = old[i] + sigma * (shifted[i] - own[i])
                new[i] = moved
                norm[i] += moved * moved
        for i in range(512):
            length = np.sqrt(norm[i])
            norm[i] = np.float32(1) / (length if length > np.float32(1) else np.float32(1))
        for axis in range(3):
            old, new, start = p[b, axis], step[axis], anchor[b, axis]
            for i in range(512):
                old[i] += relax * (new[i] * norm[i] - old[i])
            if share < 1:
                for i in range(512):
                    old[i] = start[i] + share * (old[i] - start[i])


@njit(cache=True, nogil=True, parallel=True)
def energies(u: F32, p: F32, lower: I32, upper: I32, votes: Votes, weight: float, out: F64) -> None:
    """Primal and dual energy of each block to out (blocks, 2): |grad u| + G(u), and -G*(div p).

    G(u) = weight sum_j h_j |u - l_j| on [-1, 1] is piecewise linear between the l_j, the first and last of
    which are the interval's ends, so G*(q) = max over j of q l_j - G(l_j).
    """
    h, h_row = votes
    n = h.shape[1]
    gap = 2 / (n - 1)
    for b in prange(len(u)):
        q, shifted = np.empty(512, np.float32), np.empty((3, 512), np.float32)
        _divergence(p, lower, b, q, shifted[0])
        for axis in range(3):
            _forward(u, upper, b, axis, shifted[axis])
        share = h[h_row[b]]
        primal, dual = 0.0, 0.0
        for i in range(512):
            value = np.float64(u[b, i])
            steepness = 0.0
            for axis in range(3):
                steepness += (shifted[axis, i] - value) ** 2
            primal += np.sqrt(steepness)
            data, slope = 0.0, -1.0
            at_centre = 0.0
            for j in range(n):
                centre = j * gap - 1
                data += share[j, i] * abs(value - centre)
                at_centre += share[j, i] * (centre + 1)  # G(l_0) / weight
            primal += weight * data
            conjugate = -q[i] - weight * at_centre
            for j in range(n - 1):
                slope += 2 * share[j, i]
                at_centre += slope * gap
                conjugate = max(conjugate, q[i] * ((j + 1) * gap - 1) - weight * at_centre)
            dual -= conjugate
        out[b, 0] = primal
        out[b, 1] = dual


@njit(cache=True, nogil=True)
def touched(u: F32, p: F32, lower: I32, upper: I32) -> Bool:
    """(blocks, 6): whether the missing lower (z, y, x), then upper neighbour has to be stored.

    It has where u on the face is not its constant (its gradient is then not 0) or, above, p on the face is
    not 0 (its divergence is then not 0).
    """
    needed = np.zeros((len(u), 6), np.bool_)
    for b in range(len(u)):
        for axis in range(3):
            needed[b, axis] = _differs(u[b], p[b, axis], lower[b, axis], 0, axis)
            needed[b, 3 + axis] = _differs(u[b], p[b, axis], upper[b, axis], 7, axis)
    return needed


@njit(cache=True, nogil=True)
def _differs(u: F32, p: F32, neighbour: int, layer: int, axis: int) -> bool:
    if neighbour >= 0 or neighbour == OUTSIDE:
        return False
    constant = np.float32(1 if neighbour == FREE else -1)
    stride = 64 if axis == 0 else 8 if axis == 1 else 1
    outer, inner = (1, 64) if axis == 0 else (8, 8) if axis == 1 else (64, 1)
    for o in range(outer):
        for i in range(inner):
            at = o * 8 * stride + i + layer * stride
            if u[at] != constant or (layer == 7 and p[at] != 0):
                return True
    return False
