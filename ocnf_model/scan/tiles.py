"""A region of any size and shape as overlapping cubes of one size, and the cubes' results as one octree.

A method is given cubes of `resolution` voxels along each axis. Neighbours overlap by as many voxels as the
method looks around a voxel, or as can be afforded; there the results are blended, with weights that rise
linearly from one tile to the other and sum to 1. The outer quarter of an overlap counts for nothing: beside
the border of its cube, a method lacks what lies beyond. Methods that look at nothing but the voxel itself
need no overlap, and the parts are exactly those of one piece.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F32, F64
from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree, mean_on
from ocnf_data.octree.boxes import Trees, cut_trees, join_trees
from ocnf_model.scan.region import Region

_TREE = 8
_MARGIN = 2 * _TREE
"""Voxels around a region that are fused too, so that surfaces do not end at the box."""


@dataclass(frozen=True)
class Tiling:
    """Where the tiles of a region lie.

    Attributes:
        region: the box, and in `size` the length of the grid's longest axis in metres.
        shape: voxels (D, H, W) of the grid, whose centre is the box's; multiples of 8.
        voxel: metres.
        resolution: voxels along each axis of a tile.
        overlap: voxels that neighbours share.
        starts: for each axis z, y, x the first voxel of each tile, a multiple of 8; may be negative, as tiles
            may reach beyond the grid.
    """

    region: Region
    shape: tuple[int, int, int]
    voxel: float
    resolution: int
    overlap: int
    starts: tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]

    @property
    def tiles(self) -> list[Region]:
        """The cube of each tile, z slowest."""
        first = np.array(self.region.centre) - self.voxel * np.array(self.shape[::-1]) / 2
        half = self.resolution / 2
        cubes = []
        for start in itertools.product(*self.starts):
            x, y, z = (first + self.voxel * (np.array(start[::-1]) + half)).tolist()
            cubes.append(Region.of_cube((x, y, z), self.voxel * self.resolution))
        return cubes

    def merge(self, results: Sequence[GridOctree]) -> GridOctree:
        """One octree (D, H, W) of the results of `tiles`, in that order; 1 channel in [-1, 1].

        Where tiles overlap, a leaf is as small as in the finest of them, and the values are blended. One
        dense cube is held at a time, beside the octrees.
        """
        axes = list(zip(self.starts, self.shape, strict=True))
        spans = [_spans(starts, self.resolution, n) for starts, n in axes]
        weights = [_weights(starts, self.resolution, self.overlap) for starts in self.starts]
        counts = [len(starts) for starts in self.starts]
        boxes = []
        for span in itertools.product(*spans):
            low, high = [a for a, _, _ in span], [b for _, b, _ in span]
            parts, shares = [], []
            for at in itertools.product(*(covering for _, _, covering in span)):
                start = [starts[i] for starts, i in zip(self.starts, at, strict=True)]
                inner = [[a - s, b - s] for a, b, s in zip(low, high, start, strict=True)]
                share = [w[i, a:b] for w, i, (a, b) in zip(weights, at, inner, strict=True)]
                if all(axis.any() for axis in share):
                    tile = results[int(np.ravel_multi_index(at, counts))]
                    parts.append(cut_trees(tile, *([c[k] // _TREE for c in inner] for k in (0, 1))))
                    shares.append(share)
            first: Trees = low[0] // _TREE, low[1] // _TREE, low[2] // _TREE
            boxes.append((first, parts[0] if len(parts) == 1 else _blend(parts, shares)))
        d, h, w = (n // _TREE for n in self.shape)
        return join_trees((d, h, w), boxes)


def tiled_shape(region: Region, voxel: float) -> tuple[int, int, int]:
    """Voxels (D, H, W), multiples of 8, of the grid that covers a region's box and a margin around it."""
    lengths = np.subtract(region.high, region.low)[::-1] / voxel + _MARGIN
    d, h, w = (_TREE * math.ceil(n / _TREE) for n in lengths.tolist())
    return d, h, w


def plan_tiles(region: Region, voxel: float, resolution: int, overlap: int) -> Tiling:
    """Cover a region with tiles.

    Args:
        region: only its box matters.
        voxel: metres.
        resolution: voxels along each axis of a tile, a multiple of 8.
        overlap: voxels that neighbours share, a multiple of 8, at most half the resolution.

    Raises:
        OcnfError: `overlap` is none.
    """
    if overlap % _TREE or not 0 <= overlap <= resolution // 2:
        raise OcnfError("not an overlap of tiles", field="overlap", found=overlap,
                        expected=f"a multiple of 8, up to {resolution // 2}")
    d, h, w = tiled_shape(region, voxel)
    stride = resolution - overlap
    starts = []
    for n in (d, h, w):
        count = max(math.ceil((n - overlap) / stride), 1)
        first = (n - (count * stride + overlap)) // 2 // _TREE * _TREE  # the tiles' middle is the grid's
        starts.append(tuple(first + i * stride for i in range(count)))
    return Tiling(Region(region.low, region.high, voxel * max(d, h, w)), (d, h, w), voxel, resolution,
                  overlap, (starts[0], starts[1], starts[2]))


def _spans(starts: Sequence[int], length: int, n: int) -> list[tuple[int, int, list[int]]]:
    """The parts of an axis of n voxels that the same tiles cover: (from, to, tiles)."""
    marks = sorted({0, n, *(min(max(mark, 0), n) for s in starts for mark in (s, s + length))})
    return [(a, b, [i for i, s in enumerate(starts) if s <= a and b <= s + length])
            for a, b in itertools.pairwise(marks)]


def _weights(starts: Sequence[int], length: int, overlap: int) -> F32:
    """(tiles, length): the weight of each tile's voxels along one axis; those of a voxel sum to 1."""
    weights = np.ones((len(starts), length))
    if overlap:
        margin = overlap // 4
        rise = np.clip((np.arange(overlap) + 0.5 - margin) / (overlap - 2 * margin), 0, 1)
        weights[1:, :overlap] = rise
        weights[:-1, length - overlap:] = 1 - rise
    return weights.astype(np.float32)


def _blend(parts: Sequence[GridOctree], shares: Sequence[Sequence[F32]]) -> GridOctree:
    """The weighed sum of octrees of one shape, on the union of their trees; +-1 of all stays exact."""
    trees = np.bitwise_or.reduce([part.trees for part in parts])
    total: F64 = np.zeros(parts[0].shape)
    for part, (z, y, x) in zip(parts, shares, strict=True):
        total += part.to_dense()[0] * (z[:, None, None].astype(np.float64) * y[:, None] * x)
    total[np.abs(total) > 1 - 1e-6] = np.sign(total[np.abs(total) > 1 - 1e-6])
    return GridOctree.trusted(trees, mean_on(trees, total.astype(np.float32)[None]))
