"""What a sample looks like: depth maps in colour, slices of octrees with their cells drawn in."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ocnf_data.arrays import F32, F64, I32, I64
from ocnf_data.encodings import Encoding
from ocnf_data.octree import GridOctree

if TYPE_CHECKING:
    from matplotlib.axes import Axes


AXES = "zyx"
_NO_MEASUREMENT = (0.85, 0.25, 0.25, 1.0)
# Inside or unseen, surface, free: light enough at both ends for the outlines of leaves to show.
DISTANCE_COLOURS = ("#b5483a", "#e0907f", "#ffffff", "#b9d6ec", "#8db9dd")


def as_distance(data: F32, encoding: Encoding) -> F32:
    """One signed number a leaf in [-1, 1], for display, from leaf data (n_leaves, C) of any encoding.

    The histogram gives its mean over the bins, occupancy +1 for free and -1 for occupied.
    """
    if encoding is Encoding.HISTOGRAM:
        centres = np.linspace(-1.125, 1.125, data.shape[1], dtype=np.float32)
        return np.clip(data @ centres, -1, 1)
    if encoding is Encoding.TDF_OCCUPANCY:
        return (1 - 2 * data[:, 1]) * data[:, 0]
    if encoding is Encoding.OCCUPANCY:
        return 1 - 2 * data[:, 0]
    return data[:, 0]


def signed(octree: GridOctree, encoding: Encoding) -> GridOctree:
    """The octree with `as_distance` of its leaves as its one channel: negative inside, whatever it stores."""
    return octree.with_data(np.ascontiguousarray(as_distance(octree.data, encoding)[:, None], np.float32))


def slice_cells(
    octree: GridOctree, axis: int, index: int
) -> tuple[I64, I32]:
    """The leaves that a plane of voxels cuts.

    Args:
        octree: an octree of shape (D, H, W).
        axis: 0, 1 or 2 for a plane across z, y or x.
        index: number of the plane of voxels along the axis, from 0.

    Returns:
        (n,) rows of `octree.data`, and (n, 3) int32 (row, column, width) of their squares in the plane, whose
        rows and columns are the two remaining axes in their order.
    """
    low, width = octree.leaf_positions(), octree.leaf_sizes().astype(np.int32)
    cut = np.flatnonzero((low[:, axis] <= index) & (index < low[:, axis] + width))
    row, column = (a for a in range(3) if a != axis)
    return cut, np.column_stack([low[cut, row], low[cut, column], width[cut]]).astype(np.int32)


def paint_squares(squares: I32, value: F32, size: tuple[int, int]) -> F32:
    """An image of `size` from squares (n, 3) (row, column, width) that tile it, and a value (n,) for each."""
    image = np.empty(size, dtype=np.float32)
    for width in np.unique(squares[:, 2]):
        same = squares[:, 2] == width
        row, column = squares[same, 0, None, None], squares[same, 1, None, None]
        steps = np.arange(width)
        image[row + steps[:, None], column + steps] = value[same, None, None]
    return image


class Window(NamedTuple):
    """A square part of a plane, in voxels."""

    row: float
    column: float
    width: int


def busiest_window(octree: GridOctree, axis: int, index: int, width: int) -> Window:
    """A window of `width` voxels in the middle of a plane's width-1 leaves, inside the plane."""
    squares = slice_cells(octree, axis, index)[1]
    size = np.array([n for a, n in enumerate(octree.shape) if a != axis])
    fine = squares[squares[:, 2] == 1, :2]
    middle = np.median(fine, axis=0) if len(fine) else size / 2
    row, column = np.clip(middle - width / 2, 0, np.maximum(size - width, 0))
    return Window(float(row), float(column), width)


def draw_slice(
    ax: Axes,
    octree: GridOctree,
    axis: int,
    index: int,
    encoding: Encoding = Encoding.TSDF,
    window: Window | None = None,
) -> None:
    """Draw one plane of an octree, with the outlines of its leaves: blue free, red inside or unseen.

    Args:
        ax: Matplotlib axes to draw on.
        octree: an octree of any encoding.
        axis: 0, 1 or 2 for a plane across z, y or x.
        index: number of the plane of voxels along the axis, from 0.
        encoding: encoding of the octree's values.
        window: draw only this part.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap

    rows, squares = slice_cells(octree, axis, index)
    value = as_distance(octree.data[rows], encoding)
    height, breadth = (n for a, n in enumerate(octree.shape) if a != axis)
    image = paint_squares(squares, value, (height, breadth))
    colours = LinearSegmentedColormap.from_list("distance", list(DISTANCE_COLOURS))
    ax.imshow(image, origin="lower", cmap=colours, vmin=-1, vmax=1, extent=(0, breadth, 0, height),
              interpolation="nearest")
    r, c, w = squares.T
    corners = np.stack([np.stack([c, r + w], 1), np.stack([c, r], 1), np.stack([c + w, r], 1)], 1)
    ax.add_collection(LineCollection(list(corners), colors=(0.15, 0.15, 0.2, 0.6), linewidths=0.35))
    if window is not None:
        ax.set_ylim(window.row, window.row + window.width)
        ax.set_xlim(window.column, window.column + window.width)
    left, up = (name for name in AXES if name != AXES[axis])
    ax.set_xlabel(up, labelpad=1)
    ax.set_ylabel(left, labelpad=1)
    ax.set_xticks([])
    ax.set_yticks([])


def depth_colours(depth: F32, limits: tuple[float, float]) -> F64:
    """A depth map (H, W) as RGBA (H, W, 4) in 0..1: white a free ray (`inf`), red no measurement (`0`).

    Args:
        depth: metres.
        limits: the nearest and the farthest depth of the scale, metres.
    """
    import matplotlib as mpl

    shown = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
    near, far = limits
    colours = np.asarray(mpl.colormaps["viridis_r"](np.clip((shown - near) / max(far - near, 1e-6), 0, 1)))
    colours[np.isinf(depth)] = 1.0
    colours[depth == 0] = _NO_MEASUREMENT
    return colours


def depth_limits(depth: F32) -> tuple[float, float]:
    """The nearest and the farthest measurement in metres, for `depth_colours`; 0 and 1 if there is none."""
    hit = depth[np.isfinite(depth) & (depth > 0)]
    return (float(hit.min()), float(hit.max())) if hit.size else (0.0, 1.0)


def depth_scale(n: int = 9) -> list[str]:
    """The colours of `depth_colours` from the nearest depth to the farthest, `#rrggbb`."""
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    return [to_hex(colour) for colour in mpl.colormaps["viridis_r"](np.linspace(0, 1, n))]


def draw_depth(ax: Axes, depth: F32, limits: tuple[float, float]) -> None:
    """Draw one depth map (H, W): colour is metres, white a free ray (`inf`), red no measurement (`0`)."""
    ax.imshow(depth_colours(depth, limits), interpolation="nearest")
    ax.set_xticks([])
    ax.set_yticks([])


def busiest_plane(octree: GridOctree, axis: int) -> int:
    """The plane of voxels across `axis` with the most width-1 leaves: where the surface is richest."""
    fine = octree.leaf_sizes() == 1
    if not fine.any():
        return octree.shape[axis] // 2
    return int(np.bincount(octree.leaf_positions()[fine, axis], minlength=octree.shape[axis]).argmax())
