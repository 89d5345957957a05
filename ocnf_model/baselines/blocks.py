"""Where TV-L1 keeps its volumes: only blocks of 8^3 voxels in which something can move.

A block whose histogram is free or unseen in every voxel starts out as that constant (u = 1 or -1, p = 0) and
is stored only once a neighbour moves. So the problem stays the dense one: a block that is not stored has no
gradient, no divergence and no data term, and adds exactly 0 to the primal and to the dual energy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, I32, I64, U64, Bool
from ocnf_data.octree import GridOctree
from ocnf_data.octree.bits import tree_leaves
from ocnf_model.baselines.passes import FREE, OUTSIDE, UNSEEN

_FREE_ROW, _UNSEEN_ROW = 0, 1


@dataclass(frozen=True)
class Histogram:
    """The data term by blocks.

    Attributes:
        rows: (GD, GH, GW) int32: the row of each block in `h`; 0 is free, 1 unseen in every voxel.
        h: (rows, n, 512) float32: the n bins of a block's voxels (z, y, x), which sum to 1.
    """

    rows: I32
    h: F32

    @classmethod
    def from_octree(cls, octree: GridOctree) -> Histogram:
        """Expand the trees that are not free or unseen throughout."""
        first = octree.data[octree.prefix[:-1]]
        whole = np.diff(octree.prefix) == 1
        rows = np.full(len(whole), -1, np.int32)
        rows[whole & (first[:, -1] == 1)] = _FREE_ROW
        rows[whole & (first[:, 0] == 1)] = _UNSEEN_ROW
        mixed = np.flatnonzero(rows < 0)
        rows[mixed] = np.arange(2, 2 + len(mixed))
        h = _with_constants(len(mixed), octree.channels)
        _expand(octree.trees.reshape(-1, 2), octree.prefix, octree.data, mixed, h)
        return cls(rows.reshape(octree.trees.shape[:3]), h)


def _with_constants(n_mixed: int, n_bins: int) -> F32:
    h = np.zeros((2 + n_mixed, n_bins, 512), np.float32)
    h[_FREE_ROW, -1] = 1
    h[_UNSEEN_ROW, 0] = 1
    return h


class State:
    """u and p on the stored blocks, which are kept in the order of the trees.

    Attributes:
        slots: (GD, GH, GW) int32: row of each block, or FREE or UNSEEN where it is not stored.
        u, over: (blocks, 512) float32, u and its extrapolation. p: (blocks, 3, 512) float32, z, y, x.
        anchor_u, anchor_p: where the anchored iteration started; u and p themselves before there is one.
        lower, upper: (blocks, 3) int32: the neighbours along z, y, x; as in `slots`, or OUTSIDE.
        h_row: (blocks,) int32: where the block's data term is.
    """

    def __init__(self, histogram: Histogram, stored: Bool) -> None:
        self.histogram = histogram
        rows = histogram.rows
        self.slots = np.where(rows == _FREE_ROW, FREE, UNSEEN).astype(np.int32)
        coords = np.argwhere(stored)
        self.slots[stored] = np.arange(len(coords))
        self.h_row = rows[stored]
        around = np.pad(self.slots, 1, constant_values=OUTSIDE)
        axes = np.eye(3, dtype=np.int64)
        self.lower = _pick(around, coords[:, None] + 1 - axes)
        self.upper = _pick(around, coords[:, None] + 1 + axes)
        # The mean of the histogram: a good start, and exactly 1 or -1 in free and unseen blocks.
        centres = np.linspace(-1, 1, histogram.h.shape[1], dtype=np.float32)
        self.u = (centres @ histogram.h)[self.h_row]
        self.p = np.zeros((len(coords), 3, 512), np.float32)
        self.over = self.u.copy()
        self.anchor_u, self.anchor_p = self.u, self.p

    @classmethod
    def start(cls, histogram: Histogram) -> State:
        """Every block stored that is not constant."""
        return cls(histogram, histogram.rows >= 2)

    def grown(self, needed: Bool) -> State:
        """This state with the neighbours stored that `passes.touched` asks for."""
        stored = self.slots >= 0
        coords = np.argwhere(stored)
        for axis in range(3):
            for column, step in ((axis, -1), (3 + axis, 1)):
                to = coords[needed[:, column]]
                to[:, axis] += step
                stored[tuple(to.T)] = True
        state = State(self.histogram, stored)
        kept = state.slots[self.slots >= 0]
        if self.anchored:
            state.drop_anchor()  # new blocks are still what they were at the anchor
            state.anchor_u[kept], state.anchor_p[kept] = self.anchor_u, self.anchor_p
        state.u[kept], state.over[kept], state.p[kept] = self.u, self.over, self.p
        return state

    @property
    def anchored(self) -> bool:
        """Whether the state has an anchor to be drawn to."""
        return self.anchor_u is not self.u

    def drop_anchor(self) -> None:
        """Make the current u and p the anchor."""
        self.anchor_u, self.anchor_p = self.u.copy(), self.p.copy()


def _pick(grid: I32, at: I64) -> I32:
    return np.ascontiguousarray(grid[at[..., 0], at[..., 1], at[..., 2]])


@njit(cache=True, nogil=True, parallel=True)
def _expand(trees: U64, prefix: I64, data: F32, mixed: I64,
            h: F32) -> None:
    for b in prange(len(mixed)):
        tree = mixed[b]
        cells = np.empty((512, 4), np.int16)
        for leaf in range(tree_leaves(trees[tree, 0], trees[tree, 1], cells)):
            values = data[prefix[tree] + leaf]
            total = np.float32(values.sum())
            z0, y0, x0, width = cells[leaf]
            for j in range(len(values)):
                share = values[j] / total
                for z in range(z0, z0 + width):
                    for y in range(y0, y0 + width):
                        for x in range(x0, x0 + width):
                            h[2 + b, j, 64 * z + 8 * y + x] = share
