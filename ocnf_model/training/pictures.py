"""Slices through validation samples as one picture: what goes in, what comes out, what is true."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ocnf_data.arrays import F32, U8
from ocnf_data.encodings import Encoding
from ocnf_data.octree import GridOctree
from ocnf_data.render.pictures import as_distance, busiest_plane, paint_squares, slice_cells

_AXIS = 1  # across y
_SMALLEST = 128  # pixels along a panel
_GAP = 4
# From -1, inside or unseen, over the surface to 1, free: red, white, blue.
_STOPS = np.linspace(-1, 1, 5)
_COLOURS = np.array([[181, 72, 58], [224, 144, 127], [255, 255, 255], [185, 214, 236], [141, 185, 221]])


def draw_slices(rows: Sequence[tuple[GridOctree, GridOctree, GridOctree]], encoding: Encoding) -> U8:
    """A picture with a row a sample: input, reconstruction, ground truth; red is inside, blue is free.

    Args:
        rows: of each sample the input, and the two others as TSDF / tau (or 1 - 2 occupancy).
        encoding: of the inputs.

    Returns:
        (H, W, 3) uint8. Each slice is across y, where the ground truth has most of the surface; z points up.
    """
    lines = []
    for encoded, found, true in rows:
        plane = busiest_plane(true, _AXIS)
        panels = [_panel(octree, plane, kind) for octree, kind in (
            (encoded, encoding), (found, Encoding.TSDF), (true, Encoding.TSDF))]
        lines.append(_joined(panels, axis=1))
    return _joined(lines, axis=0)


def _panel(octree: GridOctree, plane: int, encoding: Encoding) -> U8:
    cut, squares = slice_cells(octree, _AXIS, plane)
    depth, _, width = octree.shape
    values: F32 = paint_squares(squares, as_distance(octree.data[cut], encoding), (depth, width))[::-1]
    enlarge = max(_SMALLEST // depth, 1)
    channels = [np.interp(values, _STOPS, _COLOURS[:, channel]) for channel in range(3)]
    picture = np.stack(channels, axis=-1).round().astype(np.uint8)
    return picture.repeat(enlarge, axis=0).repeat(enlarge, axis=1)


def _joined(parts: Sequence[U8], axis: int) -> U8:
    """Side by side (axis 1) or one below the other (axis 0), with a grey line between."""
    shape = list(parts[0].shape)
    shape[axis] = _GAP
    line = np.full(shape, 128, np.uint8)
    joined: U8 = np.concatenate([piece for part in parts for piece in (line, part)][1:], axis=axis)
    return joined
