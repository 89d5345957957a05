"""The occupancy target: [TSDF < 0] of a TSDF octree, as the octree that dense voxels would give."""

from __future__ import annotations

import numpy as np
from numba import njit

from ocnf_data.octree import GridOctree
from ocnf_data.octree.bits import MAX_LEAVES, TREE_WIDTH, pack_block, tree_leaves

# Values are 0 or 1, so any tolerance between tells them apart.
_TOLERANCE = 0.5


def occupied(tsdf: GridOctree) -> GridOctree:
    """1 where a TSDF octree (1 channel) is negative, else 0; leaves that became equal are joined.

    Equal to `GridOctree.from_dense(tsdf.to_dense() < 0)`, one tree at a time instead of with a dense volume.
    """
    trees = np.zeros_like(tsdf.trees)
    data = np.empty((tsdf.n_leaves, 1), np.float32)  # joining only takes leaves away
    n = _join(tsdf.trees.reshape(-1, 2), tsdf.prefix, tsdf.data[:, 0] < 0, trees.reshape(-1, 2), data)
    return GridOctree(trees, data[:n].copy())


@njit(cache=True, nogil=True)
def _join(trees, prefix, values, out_trees, out_data):  # type: ignore[no-untyped-def]
    """Trees (T, 2) and one truth value a leaf -> `out_trees` (T, 2) and `out_data` (n, 1); returns n."""
    block = np.empty((TREE_WIDTH, TREE_WIDTH, TREE_WIDTH, 1), np.float32)
    packed = np.empty((MAX_LEAVES, 1), np.float32)
    cells = np.empty((MAX_LEAVES, 4), np.int16)
    total = 0
    for t in range(len(trees)):
        for leaf in range(tree_leaves(trees[t, 0], trees[t, 1], cells)):
            z, y, x, w = cells[leaf]
            block[z : z + w, y : y + w, x : x + w] = np.float32(values[prefix[t] + leaf])
        out_trees[t, 0], out_trees[t, 1], n = pack_block(block, _TOLERANCE, packed)
        out_data[total : total + n] = packed[:n]
        total += n
    return total
