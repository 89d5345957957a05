"""Which views are still open for the eight parts of a cube, and which parts are settled by that alone."""

from __future__ import annotations

import numpy as np
from numba import njit

from ocnf_data.arrays import F64, I32
from ocnf_data.fusion.accumulate import OCCUPANCY
from ocnf_data.fusion.bundles import Eight, Rule, Scene
from ocnf_data.fusion.classify import EDGE, FREE, NOTHING, SURFACE, classify, footprints

ALL_FREE, ALL_UNSEEN, MIXED = 0, 1, 2
"""State of a cube: every voxel free; every voxel unseen; to be looked at more closely."""

N_FREE, N_OPEN, STATE = range(3)
"""Columns of a tally: views that say FREE; views that are open; the state."""


@njit(cache=True, nogil=True, error_model="numpy")
def cull(scene: Scene, rule: Rule, cubes: Eight, views: I32, n_free: int, footprint: F64,
         open_views: I32, tally: I32) -> None:
    """Sort the views that are open for a cube into those of its eight parts.

    A part is settled if no view is open for it, or if some view says FREE and no view comes near a surface:
    an open view could then only say FREE as well. For OCCUPANCY one FREE view settles a part by itself.

    Args:
        scene: the cameras and images.
        rule: the encoding's.
        cubes: the parts.
        views: the views that are open for the parent, in ascending order, each `2 * view + edge`.
        n_free: number of further views that say FREE about all of the parent.
        footprint: (6, 8), working space.
        open_views: (8, V) receives the open views of each part, like `views`.
        tally: (8, 3) receives N_FREE, N_OPEN and STATE of each part.
    """
    cameras, windows, levels, size = scene.cameras, scene.windows, scene.levels, scene.size
    one_is_enough = rule.kind == OCCUPANCY
    near_surface = np.uint32(0)
    for k in range(8):
        tally[k, N_FREE], tally[k, N_OPEN] = n_free, 0
    for n in range(len(views)):
        view = views[n] >> 1
        footprints(cameras[view], size, cubes, footprint)
        for k in range(8):
            if one_is_enough and tally[k, N_FREE] > 0:
                continue
            found = classify(footprint, k, windows[view], levels, size, rule)
            if found == FREE:
                tally[k, N_FREE] += 1
            elif found != NOTHING:
                open_views[k, tally[k, N_OPEN]] = 2 * view + (1 if found & EDGE else 0)
                tally[k, N_OPEN] += 1
                if found & SURFACE == SURFACE:
                    near_surface |= np.uint32(1) << np.uint32(k)
    for k in range(8):
        surface = (near_surface >> np.uint32(k)) & np.uint32(1) != 0
        if tally[k, N_FREE] > 0 and (one_is_enough or not surface):
            tally[k, STATE] = ALL_FREE
        else:
            tally[k, STATE] = MIXED if tally[k, N_OPEN] > 0 else ALL_UNSEEN
