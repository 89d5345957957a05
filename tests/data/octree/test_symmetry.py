"""The 48 symmetries against numpy on dense volumes, and their group laws."""

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
    assert moved.structure_equal(expected)
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


@settings(deadline=None)
@given(st.data(), st.sampled_from(SYMMETRIES), st.sampled_from(SYMMETRIES))
def test_composition_and_inverse(
    octrees: Callable, data: st.DataObject, first: Symmetry, second: Symmetry
) -> None:
    octree = data.draw(octrees(channels=1))
    together, one_by_one = first.then(second)(octree), second(first(octree))
    assert together.structure_equal(one_by_one)
    np.testing.assert_array_equal(together.data, one_by_one.data)
    back = first.inverse()(first(octree))
    assert back.structure_equal(octree)
    np.testing.assert_array_equal(back.data, octree.data)


def test_they_form_the_group_of_the_cube() -> None:
    everything, rotations = set(SYMMETRIES), set(ROTATIONS)
    assert len(everything) == 48 and len(rotations) == 24
    assert SYMMETRIES[0] == ROTATIONS[0] == IDENTITY
    assert {a.then(b) for a in SYMMETRIES for b in SYMMETRIES} == everything
    assert {a.then(b) for a in ROTATIONS for b in ROTATIONS} == rotations
    assert all(a.then(a.inverse()) == IDENTITY == a.inverse().then(a) for a in SYMMETRIES)


@pytest.mark.parametrize("symmetry", SYMMETRIES, ids=str)
def test_rotations_have_determinant_one(symmetry: Symmetry) -> None:
    matrix = np.zeros((3, 3))
    for row, (axis, flip) in enumerate(zip(symmetry.axes, symmetry.flips, strict=True)):
        matrix[row, axis] = -1 if flip else 1
    assert symmetry.is_rotation == (round(np.linalg.det(matrix)) == 1)
