"""Grids of any size in octrees: padded at the far ends of the axes, so that the corner stays in place."""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F32, Bool


def padded_shape(shape: tuple[int, int, int], multiple: int = 8) -> tuple[int, int, int]:
    """(D, H, W) rounded up to multiples of `multiple` voxels."""
    depth, height, width = (-(-n // multiple) * multiple for n in shape)
    return depth, height, width


def padded(volume: F32 | Bool, shape: tuple[int, int, int], value: float = 0.0) -> F32:
    """A (D, H, W) volume as float32 in a larger one, `value` elsewhere."""
    out = np.full(shape, value, np.float32)
    depth, height, width = volume.shape
    out[:depth, :height, :width] = volume
    return out


def grid_placement(shape: tuple[int, int, int], voxel: float) -> tuple[float, tuple[float, float, float]]:
    """(extent, centre (x, y, z)) in metres for functions of `ocnf_data.fusion`: a corner at the origin."""
    depth, height, width = (n * voxel for n in shape)
    return max(depth, height, width), (width / 2, height / 2, depth / 2)
