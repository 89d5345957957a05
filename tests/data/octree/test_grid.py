"""GridOctree against a slow recursive oracle, an octree worked out by hand, and its own invariants."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree, mean_on

SHAPES = [(8, 8, 8), (16, 8, 24), (8, 24, 16)]


def blocky(rng: np.random.Generator, n_channels: int, shape: tuple[int, int, int]) -> np.ndarray:
    """A volume with leaves of every width: coarse cells, some of them disturbed in single voxels."""
    values = np.zeros((n_channels, *shape), np.float32)
    for width in (8, 4, 2, 1):
        coarse = rng.integers(0, 2, [n // width for n in shape]) * (rng.random() < 0.7)
        sparse = coarse * (rng.random(coarse.shape) < 0.1)
        values += np.kron(sparse, np.ones((width, width, width)))
    return values + np.arange(n_channels, dtype=np.float32)[:, None, None, None]


def test_golden_octree(golden: tuple[np.ndarray, GridOctree]) -> None:
    volume, expected = golden
    octree = GridOctree.from_dense(volume)
    assert np.array_equal(octree.trees, expected.trees)
    np.testing.assert_array_equal(octree.data, expected.data)
    np.testing.assert_array_equal(octree.to_dense(), volume)
    assert (octree.shape, octree.channels, octree.n_leaves) == ((8, 8, 16), 1, 1 + 6 + 14 + 16)
    # 10 bytes a tree, bit i in byte i // 8: bits 0, 6, 8, 52, 72.
    on_disk = octree.trees.view(np.uint8)[..., :10].reshape(2, 10)
    assert on_disk.tolist() == [[0] * 10, [0b0100_0001, 1, 0, 0, 0, 0, 1 << 4, 0, 0, 1]]
    corners, sizes = octree.leaf_positions(), octree.leaf_sizes()
    assert corners[0].tolist() == [0, 0, 0] and sizes[0] == 8
    assert corners[1].tolist() == [0, 0, 8] and sizes[1] == 4
    assert corners[6].tolist() == [4, 4, 8] and sizes[6] == 4  # k = 6, the last 4^3 node that is not split
    assert corners[7].tolist() == [4, 0, 12] and sizes[7] == 2
    assert corners[21].tolist() == [4, 2, 14] and sizes[21] == 1
    assert corners[36].tolist() == [7, 7, 15] and sizes[36] == 1


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("n_channels", [1, 3])
@pytest.mark.parametrize("tolerance", [None, 0.0, 0.3, 1.0])
def test_from_dense_is_the_recursive_definition(
    slow_from_dense: Callable, bits_of: Callable, shape: tuple, n_channels: int, tolerance: float | None
) -> None:
    rng = np.random.default_rng(sum(shape) + n_channels)
    values = blocky(rng, n_channels, shape)
    values[rng.random(values.shape) < 0.02] += np.float32(0.3)
    span = float(values.max()) - float(values.min())
    trees, rows = slow_from_dense(values, 1e-6 * span if tolerance is None else tolerance)
    octree = GridOctree.from_dense(values, tolerance)
    assert bits_of(octree) == trees
    np.testing.assert_array_equal(octree.data, rows)
    GridOctree(octree.trees, octree.data)  # what from_dense does not check is valid
    np.testing.assert_array_equal(mean_on(octree.trees, values), octree.data)


def test_tolerance_is_exceeded_not_reached() -> None:
    values = np.zeros((1, 8, 8, 8), np.float32)
    values[0, 7, 7, 7] = 0.5
    assert GridOctree.from_dense(values, 0.5).n_leaves == 1
    assert GridOctree.from_dense(values, np.nextafter(0.5, 0)).n_leaves == 1 + 3 * 7
    assert GridOctree.from_dense(values, np.inf).data.tolist() == [[0.5 / 512]]


def test_default_tolerance_is_relative_to_the_whole_volume() -> None:
    values = np.zeros((1, 8, 8, 16), np.float32)
    values[..., 8:] = 1e6
    values[0, 0, 0, 0] = 1.0  # exactly 1e-6 of the range
    assert GridOctree.from_dense(values).n_leaves == 2
    values[0, 0, 0, 0] = 1.001
    assert GridOctree.from_dense(values).n_leaves == 1 + 1 + 3 * 7


@pytest.mark.parametrize("value", [0.1, -1 / 3, 1e-30, 3e38, np.float32(1) / 7])
def test_the_mean_of_equal_values_is_that_value(value: float) -> None:
    octree = GridOctree.from_dense(np.full((2, 16, 16, 16), value, np.float32))
    assert octree.n_leaves == 8
    assert (octree.data == np.float32(value)).all()
    # By summing, too: a structure finer than needed takes the other path.
    fine = GridOctree.from_dense(np.random.default_rng(0).random((1, 16, 16, 16), np.float32), 0.999).trees
    assert (mean_on(fine, np.full((2, 16, 16, 16), value, np.float32)) == np.float32(value)).all()


@settings(deadline=None)
@given(st.data())
def test_maps_agree_with_each_other(octrees: Callable, data: st.DataObject) -> None:
    octree = data.draw(octrees())
    width, dense = octree.leaf_width(), octree.to_dense()
    rows = np.arange(octree.n_leaves, dtype=np.float32)[:, None]  # exact up to 2^24
    index = octree.with_data(rows).to_dense()[0].astype(int)
    np.testing.assert_array_equal(np.moveaxis(dense, 0, -1), octree.data[index])
    np.testing.assert_array_equal(width, octree.leaf_sizes()[index])
    # Each leaf covers width^3 voxels, the cube from its lowest corner.
    sizes = octree.leaf_sizes().astype(int)
    np.testing.assert_array_equal(np.bincount(index.ravel(), minlength=octree.n_leaves), sizes**3)
    corners = octree.leaf_positions()
    np.testing.assert_array_equal(index[tuple(corners.T)], np.arange(octree.n_leaves))
    np.testing.assert_array_equal(index[tuple((corners + sizes[:, None] - 1).T)], np.arange(octree.n_leaves))

    voxels = np.argwhere(np.ones(octree.shape, bool))
    np.testing.assert_array_equal(octree.gather(voxels), np.moveaxis(dense, 0, -1).reshape(len(voxels), -1))
    # The mean over its own structure gives an octree back; float64 makes it exact.
    np.testing.assert_array_equal(mean_on(octree.trees, dense), octree.data)


def test_all_leaves_and_all_split() -> None:
    assert GridOctree.from_dense(np.zeros((1, 24, 8, 8), np.float32)).n_leaves == 3
    values = np.arange(512, dtype=np.float32).reshape(1, 8, 8, 8)
    octree = GridOctree.from_dense(values)
    assert octree.n_leaves == 512 and set(octree.leaf_sizes()) == {1}
    np.testing.assert_array_equal(octree.to_dense(), values)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    values = blocky(np.random.default_rng(5), 2, (32, 24, 16))
    before = numba.get_num_threads()
    results = []
    for n_threads in (1, before):
        numba.set_num_threads(n_threads)
        octree = GridOctree.from_dense(values)
        results.append((octree.trees.tobytes(), octree.data.tobytes(), octree.to_dense().tobytes()))
    assert results[0] == results[1]


def test_it_survives_pickling_and_other_memory_orders(golden: tuple[np.ndarray, GridOctree]) -> None:
    volume, octree = golden
    copy = pickle.loads(pickle.dumps(octree))
    assert np.array_equal(copy.trees, octree.trees) and np.array_equal(copy.data, octree.data)
    again = GridOctree.from_dense(np.asfortranarray(volume))
    assert np.array_equal(again.trees, octree.trees) and np.array_equal(again.data, octree.data)
    strided = GridOctree(np.asfortranarray(octree.trees), np.repeat(octree.data, 2, axis=0)[::2])
    np.testing.assert_array_equal(strided.to_dense(), volume)


def flip(trees: np.ndarray, word: int, bit: int) -> np.ndarray:
    trees = trees.copy()
    trees[0, 0, 1, word] ^= np.uint64(1 << bit)
    return trees


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda t, d: (t.astype(np.int64), d), "uint64"),
        (lambda t, d: (t[0], d), "GD, GH, GW, 2"),
        (lambda t, d: (t[:, :, :0], d[:0]), "at least one tree"),
        (lambda t, d: (flip(t, 0, 0), d), r"trees\[0, 0, 1\].*no tree"),  # the root, not its children
        (lambda t, d: (flip(t, 0, 6), d), "no tree"),
        (lambda t, d: (flip(t, 0, 9), d), "no tree"),  # below node 1, which is not split
        (lambda t, d: (flip(t, 1, 9), d), "unused bit"),
        (lambda t, d: (flip(t, 1, 63), d), "unused bit"),
        (lambda t, d: (t, d[:-1]), "36 rows, expected 37 leaves"),
        (lambda t, d: (flip(t, 0, 53), d), "37 rows, expected 44 leaves"),
        (lambda t, d: (t, d.astype(np.float64)), "float32"),
        (lambda t, d: (t, d[:, :0]), "n_leaves, C"),
        (lambda t, d: (t, d[:, 0]), "n_leaves, C"),
        (lambda t, d: (t, np.where(d == 27, np.float32(np.nan), d)), "not finite"),
        (lambda t, d: (t, np.where(d == 1, np.float32(-np.inf), d)), "not finite"),
        (lambda t, d: (t, d.tolist()), "found list"),
    ],
)
def test_an_octree_that_exists_is_valid(
    golden: tuple[np.ndarray, GridOctree], spoil: Callable, words: str
) -> None:
    _, octree = golden
    with pytest.raises(OcnfError, match=words):
        GridOctree(*spoil(octree.trees, octree.data))


@pytest.mark.parametrize("place", [(0, 0, 0, 0), (1, 7, 7, 15), (0, 3, 5, 9)])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_from_dense_refuses_what_is_not_finite(place: tuple, value: float) -> None:
    values = np.zeros((2, 8, 8, 16), np.float32)
    values[place] = value
    with pytest.raises(OcnfError, match="not finite"):
        GridOctree.from_dense(values)


@pytest.mark.parametrize(
    ("values", "tolerance", "words"),
    [
        (np.zeros((1, 8, 8, 12), np.float32), None, "multiple of 8"),
        (np.zeros((8, 8, 8), np.float32), None, r"expected float32 \(C, D, H, W\)"),
        (np.zeros((1, 8, 8, 8)), None, "found float64"),
        (np.zeros((0, 8, 8, 8), np.float32), None, "not a volume"),
        (np.zeros((1, 8, 8, 8), np.float32), -1.0, "tolerance"),
        (np.zeros((1, 8, 8, 8), np.float32), np.nan, "tolerance"),
    ],
)
def test_from_dense_says_what_it_expects(values: np.ndarray, tolerance: float | None, words: str) -> None:
    with pytest.raises(OcnfError, match=words):
        GridOctree.from_dense(values, tolerance)


def test_other_entries_say_what_they_expect(golden: tuple[np.ndarray, GridOctree]) -> None:
    _, octree = golden
    for voxels in ([[0, 0, 16]], [[-1, 0, 0]], [[0, 8, 0]]):
        with pytest.raises(OcnfError, match="outside the volume"):
            octree.gather(voxels)
    with pytest.raises(OcnfError, match=r"integers \(N, 3\)"):
        octree.gather([[0.5, 0, 0]])
    assert octree.gather(np.empty((0, 3), int)).shape == (0, 1)
    with pytest.raises(OcnfError, match="37 leaves"):
        octree.with_data(octree.data[1:])
    assert octree.with_data(np.zeros((37, 4), np.float32)).channels == 4
    with pytest.raises(OcnfError, match="differ in size"):
        mean_on(octree.trees, np.zeros((1, 8, 8, 8), np.float32))
