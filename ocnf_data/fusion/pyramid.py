"""Min-max pyramid of depth maps: what a block of voxels can see of a view, answered in four reads.

Level l >= 1 has cells of 2^l x 2^l pixels. Entry (i, j) covers the *window* of 2 x 2 cells that starts at
cell (i, j), so that two windows along each axis cover any span of up to four cells, with less than a cell to
spare at either end. Of its window an entry keeps

    NEAREST   the least depth; 0 where a pixel has no measurement
    DEEPEST   the greatest finite depth; 0 where there is none
    FARTHEST  the greatest depth; inf where a ray is free

Missing and free pixels stay apart: the one pulls NEAREST to 0, the other FARTHEST to inf, and DEEPEST knows
neither. With both at hand a silhouette (a near object before free rays) is told from a measured slope.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ocnf_data.arrays import F32, I64
from ocnf_data.errors import OcnfError
from ocnf_data.fusion.threads import map_in_threads
from ocnf_data.views.cameras import Views

NEAREST, DEEPEST, FARTHEST = 0, 1, 2


class DepthPyramid:
    """The depth pyramids of V views, made once and shared by all fusions of these views.

    Attributes:
        views: the views themselves.
        windows: (V, n_entries, 3) float32, (NEAREST, DEEPEST, FARTHEST) of each entry; levels 1, 2, ... one
            after the other, each row by row. Four bytes a pixel in all.
        levels: (n_levels + 1, 2) int64, (first entry, entries a row) of each level; row 0 is not used.
    """

    def __init__(self, views: Views) -> None:
        if not isinstance(views, Views):
            raise OcnfError("not posed views", where="fusion", field="views", found=type(views).__name__,
                            expected="ocnf_data.Views")
        self.views = views
        self.levels, n_entries = _layout(*views.size)
        self.windows: F32 = np.empty((len(views), n_entries, 3), np.float32)

        def build(view: int) -> None:
            _build_view(views.depth[view], self.levels, self.windows[view])

        map_in_threads(build, range(len(views)))


def _layout(height: int, width: int) -> tuple[I64, int]:
    rows, first, level = [(0, 0)], 0, 0
    while level == 0 or max(height, width) > 1:
        level += 1
        height, width = (height + 1) // 2, (width + 1) // 2
        rows.append((first, width))
        first += height * width
    return np.array(rows, np.int64), first


@njit(cache=True, nogil=True, error_model="numpy")
def _build_view(depth: F32, levels: I64, windows: F32) -> None:
    """Fill `windows` (n_entries, 3) from one depth map (H, W)."""
    height, width = depth.shape
    for i in range((height + 1) // 2):
        upper, lower = depth[2 * i], depth[min(2 * i + 1, height - 1)]
        row = windows[i * levels[1, 1] : (i + 1) * levels[1, 1]]
        for j in range(len(row)):
            j0, j1 = 2 * j, min(2 * j + 1, width - 1)
            a, b, c, d = upper[j0], upper[j1], lower[j0], lower[j1]
            row[j, NEAREST] = min(min(a, b), min(c, d))
            row[j, DEEPEST] = max(max(_finite(a), _finite(b)), max(_finite(c), _finite(d)))
            row[j, FARTHEST] = max(max(a, b), max(c, d))
    for level in range(2, len(levels)):
        fine = _level(windows, levels, level - 1)
        coarse = _level(windows, levels, level)
        for i in range(coarse.shape[0]):
            i1 = min(2 * i + 1, fine.shape[0] - 1)
            for j in range(coarse.shape[1]):
                j1 = min(2 * j + 1, fine.shape[1] - 1)
                _merge(fine, 2 * i, i1, 2 * j, j1, coarse[i, j])
    for level in range(1, len(levels)):
        cells = _level(windows, levels, level)
        for i in range(cells.shape[0]):  # in place: a window reads only cells not yet replaced
            i1 = min(i + 1, cells.shape[0] - 1)
            for j in range(cells.shape[1]):
                _merge(cells, i, i1, j, min(j + 1, cells.shape[1] - 1), cells[i, j])


@njit(cache=True, nogil=True, error_model="numpy")
def _finite(depth: np.float32) -> np.float32:
    return depth if depth < np.inf else np.float32(0)


@njit(cache=True, nogil=True, error_model="numpy")
def _level(windows: F32, levels: I64, level: int) -> F32:
    """Level `level` as (rows, entries a row, 3)."""
    first, width = levels[level]
    last = levels[level + 1, 0] if level + 1 < len(levels) else len(windows)
    return windows[first:last].reshape(((last - first) // width, width, 3))


@njit(cache=True, nogil=True, error_model="numpy")
def _merge(cells: F32, i0: int, i1: int, j0: int, j1: int, out: F32) -> None:
    """Combine four cells into `out` (3,)."""
    a, b, c, d = cells[i0, j0], cells[i0, j1], cells[i1, j0], cells[i1, j1]
    out[NEAREST] = min(min(a[0], b[0]), min(c[0], d[0]))
    out[DEEPEST] = max(max(a[1], b[1]), max(c[1], d[1]))
    out[FARTHEST] = max(max(a[2], b[2]), max(c[2], d[2]))
