"""One tree in 73 bits, against Python integers and a plain walk."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.octree import bits as tree_bits

WORD = 2**64 - 1


def words(bits: int) -> tuple[np.uint64, np.uint64]:
    return np.uint64(bits & WORD), np.uint64(bits >> 64)


@settings(deadline=None)
@given(st.integers(0, 2**73 - 1), st.integers(0, 73))
def test_counts_are_those_of_python_integers(bits: int, i: int) -> None:
    lo, hi = words(bits)
    assert tree_bits.popcount(lo) == (bits & WORD).bit_count()
    assert tree_bits.leaf_count(lo, hi) == 1 + 7 * bits.bit_count()
    assert tree_bits.splits_below(lo, hi, i) == (bits & ((1 << i) - 1)).bit_count()
    if i < 73:
        assert tree_bits.is_split(lo, hi, i) == bool(bits >> i & 1)
        assert tree_bits.with_split(lo, hi, i) == words(bits | 1 << i)
    if i < 9:
        assert tree_bits.child_bits(lo, hi, i) == bits >> (8 * i + 1) & 0xFF


@settings(deadline=None)
@given(st.data())
def test_a_tree_is_what_a_walk_can_make(walk_tree: Callable, data: st.DataObject) -> None:
    wanted = data.draw(st.integers(0, 2**73 - 1) | st.just(2**73 - 1) | st.just(0))
    bits, leaves = walk_tree(lambda i, *_: bool(wanted >> i & 1), 0, 0, 0)
    lo, hi = words(bits)
    assert tree_bits.is_tree(lo, hi)
    assert tree_bits.is_tree(*words(wanted)) == (wanted == bits)
    assert not tree_bits.is_tree(lo, hi | np.uint64(1 << data.draw(st.integers(9, 63))))

    cells = np.empty((tree_bits.MAX_LEAVES, 4), np.int16)
    n = tree_bits.tree_leaves(lo, hi, cells)
    assert [tuple(cell) for cell in cells[:n].tolist()] == leaves
    for index, (z, y, x, width) in enumerate(leaves):
        last = width - 1
        assert tree_bits.leaf_of_voxel(lo, hi, z, y, x) == (index, width)
        assert tree_bits.leaf_of_voxel(lo, hi, z + last, y + last, x + last) == (index, width)


@pytest.mark.parametrize("n_channels", [1, 3])
@pytest.mark.parametrize("tolerance", [0.0, 0.25])
def test_pack_block_is_from_dense_for_one_tree(
    slow_from_dense: Callable, n_channels: int, tolerance: float
) -> None:
    rng = np.random.default_rng(n_channels)
    for n_spots in (0, 1, 5, 50, 512):
        values = np.full((8, 8, 8, n_channels), 0.1, np.float32)
        spots = rng.integers(0, 8, (n_spots, 3))
        values[tuple(spots.T)] = rng.random((n_spots, n_channels), np.float32)
        (expected_bits,), rows = slow_from_dense(values.transpose(3, 0, 1, 2), tolerance)
        out = np.empty((tree_bits.MAX_LEAVES, n_channels), np.float32)
        lo, hi, n = tree_bits.pack_block(values, tolerance, out)
        assert int(lo) | int(hi) << 64 == expected_bits
        np.testing.assert_array_equal(out[:n], rows)
