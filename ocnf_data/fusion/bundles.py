"""What fusion's kernels take together, as named tuples, which numba passes by their parts.

Taking an array out of one costs a few nanoseconds: kernels do so before their loops.
"""

from __future__ import annotations

from typing import NamedTuple

from ocnf_data.arrays import F32, F64, I32, I64


class Scene(NamedTuple):
    """V cameras and what they see.

    Attributes:
        cameras: (V, 14), see `projection.grid_cameras`.
        offsets: (V, 3, 64), see `projection.cell_offsets`.
        images: (V, H * W) float32, the depth maps row by row.
        windows: (V, n_entries, 3), the DepthPyramid's.
        levels: (n_levels + 1, 2), the DepthPyramid's.
        size: image size (H, W).
    """

    cameras: F64
    offsets: F64
    images: F32
    windows: F32
    levels: I64
    size: tuple[int, int]


class Rule(NamedTuple):
    """What an encoding makes of `dist`, which is measured depth - depth of the voxel.

    Attributes:
        kind: what to accumulate, one of accumulate's TSDF, TDF_OCCUPANCY, HISTOGRAM, OCCUPANCY.
        hidden_below: distance in metres; a pixel with dist < hidden_below contributes nothing.
        free_from: distance in metres; a pixel with dist >= free_from says free.
        truncation: tau in metres; for OCCUPANCY the threshold.
        tolerance: tolerance of the split rule, in the units of the values.
    """

    kind: int
    hidden_below: float
    free_from: float
    truncation: float
    tolerance: float


class Eight(NamedTuple):
    """The eight cubes that are the parts of one parent; part k = 4 dz + 2 dy + dx.

    Attributes:
        z: first voxel of the parent.
        y: first voxel of the parent.
        x: first voxel of the parent.
        width: voxels along each axis of a part.
    """

    z: int
    y: int
    x: int
    width: int


class Scratch(NamedTuple):
    """What a cell of 64 voxels is accumulated in: (64,) each, `votes` (64, 10)."""

    pixels: I32
    depths: F64
    measured: F64
    totals: F64
    seen: F64
    votes: F64
