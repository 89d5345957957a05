"""What rounding may and may not do to the values of each kind (docs/format.md, "An octree member")."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.octree import TARGET, GridOctree, RawOctree, quantise

INPUT_BOUND = float(np.float32(1 / 255))
BOUND = {
    TARGET: 5e-4,
    Encoding.TSDF: INPUT_BOUND,
    Encoding.OCCUPANCY: INPUT_BOUND,
    Encoding.TDF_OCCUPANCY: INPUT_BOUND,
}


def octree_of(rows: np.ndarray) -> GridOctree:
    """An octree of one-leaf trees with these rows."""
    return GridOctree(np.zeros((len(rows), 1, 1, 2), np.uint64), rows.astype(np.float32))


def there_and_back(rows: np.ndarray, kind: str) -> np.ndarray:
    raw = quantise(octree_of(rows), kind)
    RawOctree(raw.trees, raw.data, raw.kind)  # what quantise does not check is valid
    return raw.to_grid().data


def n_channels(kind: str) -> int:
    return 1 if kind == TARGET else Encoding(kind).channels


@settings(deadline=None)
@given(st.sampled_from(list(BOUND)), st.data())
def test_error_signs_and_exact_values(kind: str, data: st.DataObject) -> None:
    low = -1.0 if kind in (TARGET, Encoding.TSDF) else 0.0
    special = [low, 0.0, 1.0, 1e-45, 1e-30, 2.0**-11, 2.0**-9, 1 / 510, 0.9999999]
    special += [-value for value in special if low < 0]
    element = st.floats(low, 1, width=32) | st.sampled_from([float(np.float32(v)) for v in special])
    shape = (data.draw(st.integers(1, 30)), n_channels(kind))
    rows = data.draw(hnp.arrays(np.float32, shape, elements=element))
    back = there_and_back(rows, kind)
    assert np.abs(back.astype(float) - rows).max() <= BOUND[kind]
    np.testing.assert_array_equal(np.sign(back), np.sign(rows))
    exact = np.isin(rows, [-1, 0, 1])
    np.testing.assert_array_equal(back[exact], rows[exact])
    np.testing.assert_array_equal(there_and_back(back, kind), back)  # a second time changes nothing


@pytest.mark.parametrize("kind", list(BOUND))
def test_error_on_a_fine_scan(kind: str) -> None:
    low = -1.0 if kind in (TARGET, Encoding.TSDF) else 0.0
    values = np.linspace(low, 1, 200_003 - 200_003 % n_channels(kind), dtype=np.float32)
    rows = values.reshape(-1, n_channels(kind))
    error = np.abs(there_and_back(rows, kind).astype(float) - rows).max()
    assert 0.4 * BOUND[kind] < error <= BOUND[kind]  # the lower bound: the scan has met the worst cases


@settings(deadline=None)
@given(st.data())
def test_histograms_still_sum_to_one(data: st.DataObject) -> None:
    # Votes of a few views, each split between two neighbouring bins, as fusion makes them.
    vote = st.tuples(st.integers(0, 8), st.floats(0, 1, width=32))
    votes = data.draw(st.lists(vote, min_size=1, max_size=7))
    bins = np.zeros(10)
    for bin_index, share in votes:
        bins[bin_index] += 1 - share
        bins[bin_index + 1] += share
    row = (bins / len(votes)).astype(np.float32)[None]
    raw = quantise(octree_of(row), Encoding.HISTOGRAM)
    assert raw.data.sum(dtype=int) == 255
    back = raw.to_grid().data
    assert abs(float(back.sum(dtype=np.float64)) - 1) < 1e-6
    assert np.abs(back.astype(float) - row).max() <= INPUT_BOUND
    np.testing.assert_array_equal(back[row == 0], 0)
    np.testing.assert_array_equal(back[row == 1], 1)
    # By the definition: floors, and one more for the largest remainders.
    shares = [Fraction(float(value)) * 255 for value in row[0]]
    ranked = sorted(range(10), key=lambda b: (-(shares[b] % 1), b))
    floors = [int(share) for share in shares]
    raised = set(ranked[: 255 - sum(floors)])
    assert raw.data[0].tolist() == [floor + (b in raised) for b, floor in enumerate(floors)]


def test_one_hot_histograms_are_exact() -> None:
    np.testing.assert_array_equal(there_and_back(np.eye(10), Encoding.HISTOGRAM), np.eye(10))


@pytest.mark.parametrize(
    ("kind", "row", "words"),
    [
        (TARGET, [1.0001], "out of range; found 1.0001 to 1.0001, expected -1 to 1"),
        (Encoding.TSDF, [-1.5], "tsdf: a value is out of range"),
        (Encoding.OCCUPANCY, [-0.1], "expected 0 to 1"),
        (Encoding.TDF_OCCUPANCY, [0.5, 2], "out of range"),
        (Encoding.HISTOGRAM, [0.5] + [0] * 9, r"data\[0\]: the bins do not sum to 1"),
        (Encoding.HISTOGRAM, [0.2] * 10, "do not sum to 1"),
        (Encoding.HISTOGRAM, [0.5, 0.5], "histogram: .*channels; found 2, expected 10"),
        ("colour", [0.5], "not a kind of octree; found colour, expected target, tsdf"),
    ],
)
def test_values_that_a_kind_cannot_hold(kind: str, row: list[float], words: str) -> None:
    with pytest.raises(OcnfError, match=words):
        quantise(octree_of(np.array([row])), kind)


@pytest.mark.parametrize(
    ("kind", "data", "words"),
    [
        (TARGET, np.array([[np.nan]], np.float16), "no target has such values"),
        (TARGET, np.array([[-np.inf]], np.float16), r"data\[0\]"),
        (Encoding.TSDF, np.array([[1.001]], np.float16), "no tsdf has"),
        (Encoding.TSDF, np.array([[1.0]], np.float32), "float32 .*expected float16"),
        (Encoding.HISTOGRAM, np.full((1, 10), 25, np.uint8), "no histogram has"),
        (Encoding.HISTOGRAM, np.full((1, 10), 255, np.uint8), "no histogram has"),
        (Encoding.OCCUPANCY, np.zeros((2, 1), np.uint8), "does not fit the trees"),
    ],
)
def test_stored_data_that_a_kind_cannot_hold(kind: str, data: np.ndarray, words: str) -> None:
    with pytest.raises(OcnfError, match=words):
        RawOctree(np.zeros((1, 1, 1, 2), np.uint64), data, kind)
