"""What a data set stores of an octree: values rounded to few levels, the error bounded for each kind.

| kind          | stored        | value      | levels                                    | largest error |
|---------------|---------------|------------|-------------------------------------------|---------------|
| target        | float16, 1 ch | data       | multiples of 2^-10, and +-2^-11           | 1/2048        |
| tsdf          | float16, 1 ch | data       | multiples of 2^-7, and +-2^-8             | 1/256         |
| occupancy     | uint8, 1 ch   | data / 255 | 0..255                                    | 1/255         |
| tdf_occupancy | uint8, 2 ch   | data / 255 | 0..255                                    | 1/255         |
| histogram     | uint8, 10 ch  | data / 255 | 0..255, every row sums to 255             | 1/255         |

-1, 0, 1 and one-hot histograms survive exactly, and no sign changes: what would round to 0 without being 0
goes to the smallest level beside it. float16 holds its levels exactly, and rounding to them is what makes it
compress (docs/storage-table.md). Eight bits would not do for a TSDF: with 0 and +-1 among 255 even steps the
error is 1/254, more than an input may have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from numba import njit

from ocnf_data.arrays import F32, U8, U16, TreeArray
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.octree.bits import leaf_prefix
from ocnf_data.octree.grid import GridOctree, check_trees

TARGET = "target"
"""The kind of the ground truth: TSDF / tau of all views, stored more finely than any input."""

StoredArray: TypeAlias = npt.NDArray[Any]  # uint8 or float16


@dataclass(frozen=True)
class Storage:
    """How one kind is stored: `value = data / divisor`."""

    dtype: np.dtype
    channels: int
    divisor: int
    units: str
    low: float
    """Smallest value; the largest is 1 for every kind."""
    quantise: Callable[[F32], StoredArray]
    first_bad_row: Callable[[StoredArray], int]
    """Index of the first row of (n_leaves, C) stored data that no octree of the kind can hold, or -1."""


@dataclass(frozen=True, eq=False)
class RawOctree:
    """An octree as it is stored: trees as in `GridOctree`, data in the stored dtype. Arrays may be read-only.

    Attributes:
        trees: (GD, GH, GW, 2) uint64.
        data: (n_leaves, C) uint8 or float16, leaves in `GridOctree` order.
        kind: key of `STORAGE`; `value = data / STORAGE[kind].divisor`.

    Raises:
        OcnfError: bits that are no tree, another dtype or shape than the kind's, values out of range, or a
            number of rows that is not the number of leaves.
    """

    trees: TreeArray
    data: StoredArray
    kind: str

    def __post_init__(self) -> None:
        """Check everything, so that an octree that exists is valid."""
        storage = storage_of(self.kind)
        object.__setattr__(self, "trees", check_trees(self.trees))
        n_leaves = int(leaf_prefix(self.trees.reshape(-1, 2))[-1])
        if self.data.dtype != storage.dtype or self.data.shape != (n_leaves, storage.channels):
            raise OcnfError("the data does not fit the trees and the kind", code="structure", field="data",
                            found=f"{self.data.dtype} {self.data.shape}",
                            expected=f"{storage.dtype} {(n_leaves, storage.channels)}")
        object.__setattr__(self, "data", np.ascontiguousarray(self.data))
        bad = storage.first_bad_row(self.data)
        if bad >= 0:
            raise OcnfError(f"no {self.kind} has such values", code="range", field=f"data[{bad}]",
                            found=self.data[bad].tolist())

    @classmethod
    def trusted(cls, trees: TreeArray, data: StoredArray, kind: str) -> RawOctree:
        """Wrap arrays that are valid by construction, unchecked: for the outputs of kernels only."""
        raw = object.__new__(cls)
        for field, value in (("trees", trees), ("data", data), ("kind", kind)):
            object.__setattr__(raw, field, value)
        return raw

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, H, W) in voxels."""
        gd, gh, gw, _ = self.trees.shape
        return 8 * gd, 8 * gh, 8 * gw

    @property
    def channels(self) -> int:
        """C, values a leaf."""
        return self.data.shape[1]

    @property
    def n_leaves(self) -> int:
        """Leaves of all trees."""
        return len(self.data)

    def to_grid(self) -> GridOctree:
        """The octree with its values in float32."""
        divisor = np.float32(storage_of(self.kind).divisor)
        return GridOctree.trusted(self.trees, np.divide(self.data, divisor, dtype=np.float32))


def storage_of(kind: str) -> Storage:
    """The storage of a kind (an `Encoding` or `TARGET`), or OcnfError."""
    if kind not in STORAGE:
        raise OcnfError("not a kind of octree", field="kind", found=kind, expected=", ".join(STORAGE))
    return STORAGE[kind]


def quantise(octree: GridOctree, kind: str) -> RawOctree:
    """Round an octree's values to the levels of its kind.

    Raises:
        OcnfError: the octree has another number of channels or values outside the kind's range.
    """
    storage = storage_of(kind)
    if octree.channels != storage.channels:
        raise OcnfError("the octree does not have the kind's channels", field=str(kind),
                        found=octree.channels, expected=storage.channels)
    low, high = float(octree.data.min()), float(octree.data.max())
    if low < storage.low or high > 1:
        raise OcnfError("a value is out of range", code="range", field=str(kind),
                        found=f"{low:g} to {high:g}", expected=f"{storage.low:g} to 1")
    return RawOctree.trusted(octree.trees, storage.quantise(octree.data), str(kind))


def _round_float(step_bits: int) -> Callable[[F32], StoredArray]:
    """Round to multiples of 2^-step_bits; what would become 0 is half a step, within the same bound."""
    steps = np.float32(1 << step_bits)

    def quantise_float(values: F32) -> StoredArray:
        rounded = np.rint(values * steps) / steps  # exact but for the rint: powers of two
        vanished = (rounded == 0) & (values != 0)
        rounded[vanished] = np.copysign(np.float32(0.5) / steps, values[vanished])
        return (rounded + np.float32(0)).astype(np.float16)  # + 0 turns -0 into 0: one code for one value

    return quantise_float


def _round_share(values: F32) -> StoredArray:
    """Round [0, 1] to 0..255; what would become 0 is 1 instead."""
    return np.maximum(np.rint(values * np.float32(255)), values > 0).astype(np.uint8)


def _round_histogram(values: F32) -> StoredArray:
    stored, bad = _largest_remainder(values)
    if bad >= 0:
        raise OcnfError("the bins do not sum to 1", code="range", field=f"data[{bad}]",
                        found=values[bad].tolist())
    return stored


@njit(cache=True, nogil=True)
def _largest_remainder(values: F32) -> tuple[U8, int]:
    """Rows that sum to 1 -> rows of uint8 that sum to 255, and the first row that does not sum to 1, or -1.

    Floors first; the units that are missing go to the largest remainders, the lower bin first among equals.
    So each bin is off by less than one unit, and a bin that is a whole number of units is not off at all.
    """
    n_rows, n_bins = values.shape
    stored = np.empty((n_rows, n_bins), np.uint8)
    remainder = np.empty(n_bins)
    for row in range(n_rows):
        total, missing = 0.0, 255
        for b in range(n_bins):
            share = 255.0 * values[row, b]
            total += share
            floor = int(share)
            stored[row, b] = floor
            missing -= floor
            remainder[b] = share - floor
        if abs(total - 255.0) > 0.02:
            return stored, row
        for _ in range(missing):
            largest = 0
            for b in range(1, n_bins):
                if remainder[b] > remainder[largest]:
                    largest = b
            stored[row, largest] += 1
            remainder[largest] = -1.0
    return stored, -1


@njit(cache=True, nogil=True)
def _first_bad_histogram(data: U8) -> int:
    n_rows, n_bins = data.shape
    for row in range(n_rows):
        total = 0
        for b in range(n_bins):
            total += data[row, b]
        if total != 255:
            return row
    return -1


@njit(cache=True, nogil=True)
def _first_beyond_one(words: U16) -> int:
    # A float16 is finite and at most 1 in size iff its bits without the sign are at most those of 1.
    n_bad = 0
    for i in range(len(words)):
        n_bad += (words[i] & np.uint16(0x7FFF)) > np.uint16(0x3C00)
    if n_bad:
        for i in range(len(words)):
            if (words[i] & np.uint16(0x7FFF)) > np.uint16(0x3C00):
                return i
    return -1


def _first_bad_float(data: StoredArray) -> int:
    bad = _first_beyond_one(data.reshape(-1).view(np.uint16))
    return bad if bad < 0 else bad // data.shape[1]


def _any_byte_is_fine(data: StoredArray) -> int:
    return -1


_U8, _F16 = np.dtype(np.uint8), np.dtype(np.float16)

STORAGE: MappingProxyType[str, Storage] = MappingProxyType({
    TARGET: Storage(_F16, 1, 1, "TSDF / tau", -1.0, _round_float(10), _first_bad_float),
    str(Encoding.TSDF): Storage(_F16, 1, 1, "TSDF / tau", -1.0, _round_float(7), _first_bad_float),
    str(Encoding.OCCUPANCY): Storage(_U8, 1, 255, "1 = occupied or unseen", 0.0, _round_share,
                                     _any_byte_is_fine),
    str(Encoding.TDF_OCCUPANCY): Storage(_U8, 2, 255, "|TSDF| / tau, TSDF < 0", 0.0, _round_share,
                                         _any_byte_is_fine),
    str(Encoding.HISTOGRAM): Storage(_U8, 10, 255, "share of views", 0.0, _round_histogram,
                                     _first_bad_histogram),
})
"""Every kind of octree in a data set."""
