"""Rows of features copied and summed by compiled code: on a CPU, faster than PyTorch's own operations.

For a convolution, those around each voxel of an octet are put side by side: the 64 rows in and around the
octet go into a tile that stays in the first cache, from which each of its eight voxels takes nine pieces of
three rows that lie side by side there too. Those around a leaf of width 2 are summed there, axis by axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from ocnf_data.arrays import I32, I64
from ocnf_model.octree.neighbours import N_AROUND


def _memcpy(context: Any, out: Any, to: Any, source: Any, start: Any, n: Any) -> Any:
    """Copy `n` elements, source[start:] to out[to:]: numba's loops and slices take twice the time."""
    signature = types.void(out, types.intp, source, types.intp, types.intp)

    def generate(target: Any, builder: Any, _: Any, arguments: Any) -> Any:
        data = [target.make_array(kind)(target, builder, argument).data
                for kind, argument in ((out, arguments[0]), (source, arguments[2]))]
        onto, taken = builder.gep(data[0], [arguments[1]]), builder.gep(data[1], [arguments[3]])
        size = target.get_abi_sizeof(target.get_data_type(out.dtype))
        cgutils.raw_memcpy(builder, onto, taken, arguments[4], size)
        return target.get_dummy_value()

    return signature, generate


_copy: Any = intrinsic(_memcpy)


@njit(cache=True, nogil=True)
def gather_octets(octets: I32, features: Any, out: Any) -> None:
    """Write the 27 rows around each voxel of o octets.

    Args:
        octets: (o, 64) the leaves at the 4x4x4 voxels in and around each; L outside the grid.
        features: (L, C) of any dtype.
        out: (8 o, 27 C) of the same dtype.
    """
    channels = features.shape[1]
    tile = np.empty(N_AROUND * channels, features.dtype)
    features, out = features.reshape(-1), out.reshape(-1)
    for o in range(len(octets)):
        _fill(tile, octets, o, features, channels)
        for v in range(8):
            first = 16 * (v >> 2) + 4 * ((v >> 1) & 1) + (v & 1)
            _put(out, (8 * o + v) * 27 * channels, tile, first, channels)


@njit(cache=True, nogil=True)
def average_twos(twos: I32, features: Any, out: Any) -> None:
    """Write the 27 means that a convolution reads around each of w leaves of width 2.

    Args:
        twos: (w, 64) the leaves at the 4x4x4 voxels in and around each; L outside the grid.
        features: (L, C) float32 or float64.
        out: (w, 27 C) of the same dtype.
    """
    channels = features.shape[1]
    tile, sums = np.empty(N_AROUND * channels, features.dtype), np.empty(N_AROUND * channels, features.dtype)
    features, out = features.reshape(-1), out.reshape(-1)
    for w in range(len(twos)):
        _fill(tile, twos, w, features, channels)
        _add_up(tile, sums, channels)
        for i in range(len(sums)):
            tile[i] = sums[i] * tile.dtype.type(0.125)
        _put(out, w * 27 * channels, tile, 0, channels)


@njit(cache=True, nogil=True)
def average_twos_bfloat16(twos: I32, features: Any, out: Any) -> None:
    """`average_twos` of bfloat16, whose bits are `features` and `out`, uint16; sums are made in float32."""
    channels = features.shape[1]
    tile = np.empty(N_AROUND * channels, np.uint16)
    wide, sums = np.empty(N_AROUND * channels, np.float32), np.empty(N_AROUND * channels, np.float32)
    bits = wide.view(np.uint32)
    features, out = features.reshape(-1), out.reshape(-1)
    for w in range(len(twos)):
        _fill(tile, twos, w, features, channels)
        for i in range(len(tile)):
            bits[i] = np.uint32(tile[i]) << np.uint32(16)
        _add_up(wide, sums, channels)
        for i in range(len(sums)):
            wide[i] = sums[i] * np.float32(0.125)
        for i in range(len(tile)):  # to the nearest, of two to the even one
            odd = (bits[i] >> np.uint32(16)) & np.uint32(1)
            tile[i] = np.uint16((bits[i] + np.uint32(0x7FFF) + odd) >> np.uint32(16))
        _put(out, w * 27 * channels, tile, 0, channels)


@njit(cache=True, nogil=True)
def _fill(tile: Any, around: I32, row: int, features: Any, channels: int) -> None:
    """Copy the 64 rows of features (L C,) that a row of `around` names into the tile (64 C,)."""
    for n in range(N_AROUND):
        start = around[row, n] * channels
        if start == len(features):
            tile[n * channels : (n + 1) * channels] = 0
        else:
            _copy(tile, n * channels, features, start, channels)


@njit(cache=True, nogil=True)
def _put(out: Any, to: int, tile: Any, first: int, channels: int) -> None:
    """Copy the 3x3x3 rows of a tile (4, 4, 4, C) from row `first` on to `out`."""
    for k in range(9):
        row = first + 16 * (k // 3) + 4 * (k % 3)
        _copy(out, to + 3 * k * channels, tile, row * channels, 3 * channels)


@njit(cache=True, nogil=True)
def _add_up(tile: Any, sums: Any, channels: int) -> None:
    """Sums over 2x2x2 rows of a tile (4, 4, 4, C), at the first of the eight; the tile is overwritten.

    Rows at the end of an axis get what has no meaning: three long loops are faster than many short ones.
    """
    _add(tile, tile[channels:], sums)
    _add(sums, sums[4 * channels :], tile)
    _add(tile, tile[16 * channels :], sums)


@njit(cache=True, nogil=True)
def _add(a: Any, b: Any, out: Any) -> None:
    """Out = a + b as far as b goes."""
    for i in range(len(b)):
        out[i] = a[i] + b[i]


@njit(cache=True, nogil=True)
def copy_rows(places: I64, rows: Any, out: Any) -> None:
    """out[places] = rows: (m,), (m, C) and (n, C) of one dtype."""
    channels = rows.shape[1]
    rows, out = rows.reshape(-1), out.reshape(-1)
    for n in range(len(places)):
        _copy(out, places[n] * channels, rows, n * channels, channels)
