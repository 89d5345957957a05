"""The 48 symmetries against numpy on dense volumes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.encodings import Encoding
from ocnf_data.octree import ROTATIONS, SYMMETRIES, TARGET, GridOctree, RawOctree, Symmetry, quantise

IDENTITY = Symmetry((0, 1, 2), (False, False, False))


def on_dense(symmetry: Symmetry, volume: np.ndarray) -> np.ndarray:
    """The definition, on (C, D, H, W)."""
    turned = np.transpose(volume, (0, *(1 + axis for axis in symmetry.axes)))
    return np.flip(turned, [1 + j for j in range(3) if symmetry.flips[j]])


@pytest.mark.parametrize("symmetry", SYMMETRIES, ids=lambda s: f"{s.axes}{[int(f) for f in s.flips]}")
def test_it_is_transpose_and_flip(golden: tuple[np.ndarray, GridOctree], symmetry: Symmetry) -> None:
    volume, octree = golden
    expected = GridOctree.from_dense(np.ascontiguousarray(on_dense(symmetry, volume)))
    moved = symmetry(octree)
    assert np.array_equal(moved.trees, expected.trees)
    np.testing.assert_array_equal(moved.data, expected.data)


@settings(deadline=None)
@given(st.data(), st.sampled_from(SYMMETRIES))
def test_any_structure_and_any_dtype(octrees: Callable, data: st.DataObject, symmetry: Symmetry) -> None:
    octree = data.draw(octrees(channels=1))
    moved = symmetry(octree)
    GridOctree(moved.trees, moved.data)  # what the kernel makes is valid
    np.testing.assert_array_equal(moved.to_dense(), on_dense(symmetry, octree.to_dense()))
    np.testing.assert_array_equal(
        moved.leaf_width(), on_dense(symmetry, octree.leaf_width()[None])[0]
    )
    unsigned = octree.with_data(np.abs(octree.data))
    for raw in (quantise(octree, TARGET), quantise(unsigned, Encoding.OCCUPANCY)):
        turned = symmetry(raw)
        RawOctree(turned.trees, turned.data, turned.kind)
        assert turned.data.dtype == raw.data.dtype
        dense = raw.to_grid().to_dense()
        np.testing.assert_array_equal(turned.to_grid().to_dense(), on_dense(symmetry, dense))


def matrix(symmetry: Symmetry) -> np.ndarray:
    """(3, 3): the signed permutation that takes coordinates of the result to those of the operand."""
    signs = np.where(symmetry.flips, -1, 1)
    return signs[:, None] * np.eye(3, dtype=int)[list(symmetry.axes)]


def test_they_are_the_symmetries_of_the_cube() -> None:
    """All 48 signed permutations, each once; the rotations are the 24 of determinant 1."""
    everything = {matrix(symmetry).tobytes() for symmetry in SYMMETRIES}
    assert len(everything) == len(SYMMETRIES) == 48
    rotations = {symmetry for symmetry in SYMMETRIES if round(np.linalg.det(matrix(symmetry))) == 1}
    assert set(ROTATIONS) == rotations
    assert len(ROTATIONS) == 24
    assert SYMMETRIES[0] == ROTATIONS[0] == IDENTITY
