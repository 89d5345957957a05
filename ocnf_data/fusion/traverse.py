"""From the root cubes of 16^3 voxels down to cells of 4^3, straight into trees and leaves.

At each size a view that is FREE or says NOTHING about a cube is settled for all of it; only the others go on
to its eight parts. A cube on which every view is settled, or where at least one says FREE and none comes near
a surface, is constant: a leaf, or eight, without a voxel evaluated. No dense volume exists at any time.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ocnf_data.fusion.accumulate import (
    CELL_VOXELS,
    HISTOGRAM,
    N_BINS,
    OCCUPANCY,
    add_sight,
    add_tsdf,
    add_votes,
    finish,
    project,
    project_edge,
    read,
)
from ocnf_data.fusion.classify import EDGE, FREE, NOTHING, SURFACE, classify
from ocnf_data.octree.bits import pack_block

ROOT = 16
"""Side of the cubes at which classification begins, in voxels."""

_MIXED, _FREE, _UNSEEN = 0, 1, 2


@njit(cache=True, nogil=True, error_model="numpy")
def fuse_row(kind, cameras, offsets, depth, windows, levels, near, far, truncation, tolerance, constants,
             root_z, root_y, trees, counts):
    """Fuse the row of root cubes (root_z, root_y, all x).

    Args:
        kind: what to accumulate, one of accumulate's TSDF, TDF_OCCUPANCY, HISTOGRAM, OCCUPANCY.
        cameras, offsets: `frames.grid_cameras` (V, 14) and `frames.cell_offsets` (V, 3, 64).
        depth: (V, H, W) float32.
        windows, levels: the DepthPyramid's.
        near, far: metres, see `classify`.
        truncation: tau in metres; for OCCUPANCY the threshold.
        tolerance: of the split rule, in the units of the values.
        constants: (2, C) float32, values of a free voxel and of an unseen one.
        trees: (GD, GH, GW, 2) uint64, zeros; the row's trees are written.
        counts: (GD, GH, GW) int32; leaves of the row's trees are written.

    Returns:
        (n, C) float32: leaves of the row's trees, root cubes along x, in each its trees in (z, y, x) order.
    """
    n_views, height, width = depth.shape
    channels = constants.shape[1]
    grid = counts.shape
    images = depth.reshape((n_views, height * width))
    lists = np.empty((4, n_views), np.int64)  # the views still in play at 16, 8 and 4 voxels
    lists[0] = np.arange(n_views)
    flags = np.empty(n_views, np.int64)
    values = np.empty((8, 8, 8, channels), np.float32)
    pixels = np.empty(CELL_VOXELS, np.int32)
    depths, measured = np.empty(CELL_VOXELS), np.empty(CELL_VOXELS)
    totals, seen = np.empty(CELL_VOXELS), np.empty(CELL_VOXELS)
    votes = np.empty((CELL_VOXELS, N_BINS))
    leaves = np.empty((8 * 512 * ((grid[2] + 1) // 2), channels), np.float32)
    n_leaves = 0
    for root_x in range((grid[2] + 1) // 2):
        z0, y0, x0 = ROOT * root_z, ROOT * root_y, ROOT * root_x
        n1, free1, state1 = _sift(cameras, windows, levels, (height, width), z0, y0, x0, ROOT, near, far,
                                  kind == OCCUPANCY, lists[0], n_views, 0, lists[1], flags)
        for tree in range(8):
            gz, gy, gx = 2 * root_z + (tree >> 2), 2 * root_y + (tree >> 1 & 1), 2 * root_x + (tree & 1)
            if gz >= grid[0] or gy >= grid[1] or gx >= grid[2]:
                continue
            z1, y1, x1 = 8 * gz, 8 * gy, 8 * gx
            state2 = state1
            n2, free2 = 0, 0
            if state1 == _MIXED:
                n2, free2, state2 = _sift(cameras, windows, levels, (height, width), z1, y1, x1, 8, near, far,
                                          kind == OCCUPANCY, lists[1], n1, free1, lists[2], flags)
            if state2 != _MIXED:
                leaves[n_leaves] = constants[0 if state2 == _FREE else 1]
                counts[gz, gy, gx] = 1
                n_leaves += 1
                continue
            for cell in range(8):
                dz, dy, dx = 4 * (cell >> 2), 4 * (cell >> 1 & 1), 4 * (cell & 1)
                z, y, x = z1 + dz, y1 + dy, x1 + dx
                block = values[dz : dz + 4, dy : dy + 4, dx : dx + 4]
                n3, free3, state3 = _sift(cameras, windows, levels, (height, width), z, y, x, 4, near, far,
                                          kind == OCCUPANCY, lists[2], n2, free2, lists[3], flags)
                if state3 != _MIXED:
                    block[:, :, :] = constants[0 if state3 == _FREE else 1]
                    continue
                totals[:] = 0
                seen[:] = 0
                if kind == HISTOGRAM:
                    votes[:] = 0
                for k in range(n3):
                    view = lists[3, k]
                    if flags[k]:
                        project_edge(cameras[view], offsets[view], z, y, x, pixels, depths, (height, width))
                    else:
                        project(cameras[view], offsets[view], z, y, x, pixels, depths, width)
                    read(images[view], pixels, measured)
                    if kind == OCCUPANCY:
                        add_sight(measured, depths, truncation, seen)
                    elif kind == HISTOGRAM:
                        add_votes(measured, depths, truncation, votes, seen)
                    else:
                        add_tsdf(measured, depths, truncation, totals, seen)
                finish(kind, totals, votes, seen, free3, block)
            lo, hi, n = pack_block(values, tolerance, leaves[n_leaves : n_leaves + 512])
            trees[gz, gy, gx, 0], trees[gz, gy, gx, 1] = lo, hi
            counts[gz, gy, gx] = n
            n_leaves += n
    return leaves[:n_leaves].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def _sift(cameras, windows, levels, size, z, y, x, side, near, far, any_free, views, n_views, n_free,
          remaining, flags):
    """Settle what can be settled about the cube at (z, y, x).

    Of the first `n_views` of `views` those not settled go to `remaining`, with `flags` telling which touch the
    image's edge. `n_free` views are known to be FREE; with `any_free` one is enough.

    Returns:
        (number remaining, number of FREE views, _MIXED | _FREE | _UNSEEN).
    """
    half = 0.5 * (side - 1)
    n_remaining = 0
    surface = False
    for k in range(n_views):
        if any_free and n_free > 0:
            return 0, n_free, _FREE
        view = views[k]
        found = classify(cameras[view], windows[view], levels, size, z + half, y + half, x + half, half,
                         near, far)
        if found == FREE:
            n_free += 1
        elif found != NOTHING:
            remaining[n_remaining] = view
            flags[n_remaining] = found & EDGE
            surface = surface or (found & SURFACE) == SURFACE
            n_remaining += 1
    if n_free > 0 and (any_free or not surface):
        return 0, n_free, _FREE
    return n_remaining, n_free, _MIXED if n_remaining > 0 else _UNSEEN


@njit(cache=True, nogil=True, error_model="numpy")
def place_row(row_leaves, prefix, root_z, root_y, counts, data):
    """Copy the leaves of a row (see `fuse_row`) to their places in `data` (n_leaves, C)."""
    grid = counts.shape
    n = 0
    for root_x in range((grid[2] + 1) // 2):
        for tree in range(8):
            gz, gy, gx = 2 * root_z + (tree >> 2), 2 * root_y + (tree >> 1 & 1), 2 * root_x + (tree & 1)
            if gz >= grid[0] or gy >= grid[1] or gx >= grid[2]:
                continue
            start = prefix[(gz * grid[1] + gy) * grid[2] + gx]
            for k in range(counts[gz, gy, gx]):
                data[start + k] = row_leaves[n + k]
            n += counts[gz, gy, gx]
