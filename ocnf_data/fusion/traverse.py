"""Fuse root cubes of 32^3 voxels down to cells of 4^3, straight into trees and leaves.

At each size a view that says FREE or NOTHING about a cube is settled for all of it; only the others go on to
its eight parts. A cube that is settled is constant: a leaf a tree, without a voxel evaluated. No dense
volume exists at any time.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ocnf_data.arrays import F32, I32, I64, U64
from ocnf_data.fusion.accumulate import (
    CELL_VOXELS,
    HISTOGRAM,
    N_BINS,
    OCCUPANCY,
    add_sight,
    add_tsdf,
    add_votes,
    project,
    project_edge,
    read,
    write_cell,
)
from ocnf_data.fusion.bundles import Eight, Rule, Scene, Scratch
from ocnf_data.fusion.cull import MIXED, N_FREE, N_OPEN, STATE, cull
from ocnf_data.fusion.projection import CELL
from ocnf_data.octree.bits import MAX_LEAVES, pack_block

ROOT = 32
"""Voxels along each axis of the cubes at which the descent begins."""
ROOT_TREES = ROOT // 8
"""Trees along each axis of these cubes."""


@njit(cache=True, nogil=True, error_model="numpy")
def fuse_row(scene: Scene, rule: Rule, constants: F32, root_z: int, root_y: int, trees: U64,
             counts: I32) -> F32:
    """Fuse the row of root cubes (root_z, root_y, all x).

    Args:
        scene: the cameras and images.
        rule: the encoding's.
        constants: (2, C) float32, the values of a free voxel and of an unseen one.
        root_z: place of the row along z, counted in root cubes.
        root_y: place of the row along y, counted in root cubes.
        trees: (GD, GH, GW, 2) uint64, zeros; the row's trees are written.
        counts: (GD, GH, GW) int32; the row's numbers of leaves are written.

    Returns:
        (n, C) float32: the leaves of the row's trees, in the order of `tree_of_root`.
    """
    n_views, n_channels = len(scene.cameras), constants.shape[1]
    gd, gh, gw = counts.shape
    everything = 2 * np.arange(n_views, dtype=np.int32)
    footprint = np.empty((6, 8))
    open16, tally16 = np.empty((8, n_views), np.int32), np.empty((8, 3), np.int32)
    open8, tally8 = np.empty((8, n_views), np.int32), np.empty((8, 3), np.int32)
    open4, tally4 = np.empty((8, n_views), np.int32), np.empty((8, 3), np.int32)
    values = np.empty((8, 8, 8, n_channels), np.float32)
    scratch = _scratch()
    n_roots = -(-gw // ROOT_TREES)
    leaves = np.empty((ROOT_TREES**3 * MAX_LEAVES * n_roots, n_channels), np.float32)
    n_leaves = 0
    for root_x in range(n_roots):
        parts = Eight(ROOT * root_z, ROOT * root_y, ROOT * root_x, 16)
        cull(scene, rule, parts, everything, 0, footprint, open16, tally16)
        for k in range(64):
            part, tree = k >> 3, k & 7
            gz, gy, gx = tree_of_root(root_z, root_y, root_x, k)
            state = tally16[part, STATE]
            if tree == 0 and state == MIXED:
                cull(scene, rule, Eight(8 * gz, 8 * gy, 8 * gx, 8), open16[part, : tally16[part, N_OPEN]],
                     tally16[part, N_FREE], footprint, open8, tally8)
            if gz >= gd or gy >= gh or gx >= gw:
                continue
            if state == MIXED:
                state = tally8[tree, STATE]
            if state != MIXED:
                leaves[n_leaves] = constants[state]
                counts[gz, gy, gx] = 1
                n_leaves += 1
                continue
            cells = Eight(8 * gz, 8 * gy, 8 * gx, 4)
            cull(scene, rule, cells, open8[tree, : tally8[tree, N_OPEN]], tally8[tree, N_FREE], footprint,
                 open4, tally4)
            _fuse_cells(scene, rule, constants, cells, open4, tally4, scratch, values)
            lo, hi, n = pack_block(values, rule.tolerance, leaves[n_leaves : n_leaves + MAX_LEAVES])
            trees[gz, gy, gx, 0], trees[gz, gy, gx, 1] = lo, hi
            counts[gz, gy, gx] = n
            n_leaves += n
    return leaves[:n_leaves].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def tree_of_root(root_z: int, root_y: int, root_x: int, k: int) -> tuple[int, int, int]:
    """Tree `k` (0..63) of a root cube: its parts of 16^3 in (z, y, x) order, in each its eight trees."""
    part, tree = k >> 3, k & 7
    return (ROOT_TREES * root_z + 2 * (part >> 2) + (tree >> 2),
            ROOT_TREES * root_y + 2 * (part >> 1 & 1) + (tree >> 1 & 1),
            ROOT_TREES * root_x + 2 * (part & 1) + (tree & 1))


@njit(cache=True, nogil=True, error_model="numpy")
def _scratch() -> Scratch:
    return Scratch(np.empty(CELL_VOXELS, np.int32), np.empty(CELL_VOXELS), np.empty(CELL_VOXELS),
                   np.empty(CELL_VOXELS), np.empty(CELL_VOXELS), np.empty((CELL_VOXELS, N_BINS)))


@njit(cache=True, nogil=True, error_model="numpy")
def _fuse_cells(scene: Scene, rule: Rule, constants: F32, cells: Eight, open_views: I32, tally: I32,
                scratch: Scratch, values: F32) -> None:
    """Values of the eight cells of a tree into `values` (8, 8, 8, C); open views and tally are `cull`'s."""
    cameras, offsets, images, size = scene.cameras, scene.offsets, scene.images, scene.size
    pixels, depths, measured, totals, seen, votes = scratch
    kind = rule.kind
    for cell in range(8):
        dz, dy, dx = CELL * (cell >> 2), CELL * (cell >> 1 & 1), CELL * (cell & 1)
        z, y, x = cells.z + dz, cells.y + dy, cells.x + dx
        block = values[dz : dz + CELL, dy : dy + CELL, dx : dx + CELL]
        if tally[cell, STATE] != MIXED:
            block[:, :, :] = constants[tally[cell, STATE]]
            continue
        totals[:] = 0
        seen[:] = 0
        if kind == HISTOGRAM:
            votes[:] = 0
        for n in range(tally[cell, N_OPEN]):
            view, edge = open_views[cell, n] >> 1, open_views[cell, n] & 1
            if edge:
                project_edge(cameras[view], offsets[view], z, y, x, pixels, depths, size)
            else:
                project(cameras[view], offsets[view], z, y, x, pixels, depths, size)
            read(images[view], pixels, measured)
            if kind == OCCUPANCY:
                add_sight(measured, depths, rule.truncation, seen)
            elif kind == HISTOGRAM:
                add_votes(measured, depths, rule.truncation, votes, seen)
            else:
                add_tsdf(measured, depths, rule.truncation, totals, seen)
        write_cell(kind, totals, votes, seen, tally[cell, N_FREE], block)


@njit(cache=True, nogil=True, error_model="numpy")
def place_row(row_leaves: F32, prefix: I64, root_z: int, root_y: int, counts: I32, data: F32) -> None:
    """Copy the leaves of a row (see `fuse_row`) to where `prefix`, by tree in C order, says in `data`."""
    gd, gh, gw = counts.shape
    n = 0
    for root_x in range(-(-gw // ROOT_TREES)):
        for k in range(64):
            gz, gy, gx = tree_of_root(root_z, root_y, root_x, k)
            if gz < gd and gy < gh and gx < gw:
                count = counts[gz, gy, gx]
                start = prefix[(gz * gh + gy) * gw + gx]
                data[start : start + count] = row_leaves[n : n + count]
                n += count
