"""Boxes of trees, cut out of the grids of a batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ocnf_data.arrays import I64
from ocnf_data.errors import OcnfError
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.structure import Structure


def crop(x: OctreeBatch, corners: I64, shape: tuple[int, int, int],
         grids: Sequence[int] | None = None) -> OctreeBatch:
    """A box of each grid, as a batch of its own; differentiable.

    A box consists of whole trees, so its leaves are leaves of the grid, and no value changes.

    Args:
        x: B grids.
        corners: (N, 3) first tree of each box along (z, y, x).
        shape: trees along each axis, the same for all boxes.
        grids: (N,) which grid each box is cut out of; None: one of each, N = B.

    Raises:
        OcnfError: a box reaches out of its grid.
    """
    structure = x.structure
    chosen = np.arange(x.batch_size) if grids is None else np.asarray(grids, np.int64)
    if corners.shape != (len(chosen), 3):
        raise OcnfError("a corner for each box is needed", where="crop", field="corners",
                        found=corners.shape, expected=(len(chosen), 3))
    if (corners < 0).any() or (corners + shape > structure.grid).any() or min(shape) < 1:
        raise OcnfError("the box does not lie in the grid", where="crop", field="corners",
                        found=f"{corners.tolist()} with {shape} trees", expected=f"within {structure.grid}")
    z, y, w = (corners[:, axis, None] + np.arange(shape[axis]) for axis in range(3))  # (N, shape[axis])
    gd, gh, gw = structure.grid
    trees = (chosen[:, None, None, None] * gd + z[:, :, None, None]) * gh + y[:, None, :, None]
    trees = (trees * gw + w[:, None, None, :]).reshape(-1)                   # (T,), T = N * trees of a box
    first, n_leaves = structure.prefix[trees], np.diff(structure.prefix)[trees]  # (T,)
    before = np.cumsum(n_leaves) - n_leaves                                 # (T,)
    rows = np.repeat(first - before, n_leaves) + np.arange(n_leaves.sum())  # (L,)
    boxes = Structure(structure.flat[trees].reshape(len(chosen), *shape, 2))
    return OctreeBatch(boxes, x.features.index_select(0, torch.from_numpy(rows).to(x.device)))
