"""The noise depends on (seed, key, view) and on nothing else (promise 9)."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ocnf_data.errors import OcnfError
from ocnf_data.views.noise import add_noise, view_noise

TINY = np.finfo(np.float32).tiny


def test_golden_values() -> None:
    """Fails if numpy ever changes its stream: data sets would no longer be the same."""
    noise = view_noise(0, "chair_0001", 26, (480, 640))
    assert noise.dtype == np.float32
    ends = np.stack([noise[0, :4], noise[479, 636:]]).view(np.uint32)  # the last ones depend on all before
    np.testing.assert_array_equal(ends, np.array([
        [0x3e9b7301, 0x401981e5, 0xbff156e7, 0x3f052750],
        [0xbfd64cb0, 0x3e39b64d, 0x3ef54c99, 0x3f27ef0a],
    ], np.uint32))


def test_the_same_in_another_process_and_order() -> None:
    here = {view: view_noise(3, "bed", view, (6, 7)) for view in (52, 0, 26)}
    code = ("import sys; from ocnf_data.views.noise import view_noise; "
            "[sys.stdout.buffer.write(view_noise(3, 'bed', v, (6, 7)).tobytes()) for v in (0, 26, 52)]")
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    assert there == b"".join(here[view].tobytes() for view in (0, 26, 52))


def test_it_leaves_numpys_global_state_alone() -> None:
    before = np.random.get_state()[1].copy()  # noqa: NPY002 - the legacy state is what is tested
    view_noise(0, "a", 0, (4, 4))
    np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002


@pytest.mark.parametrize("other", [(1, "chair", 3), (0, "chair2", 3), (0, "chair", 4), (10, "chair", 3),
                                   (0, "0chair", 3), (-1, "chair", 3)])
def test_every_part_of_the_name_counts(other: tuple[int, str, int]) -> None:
    a, b = view_noise(0, "chair", 3, (200, 200)), view_noise(*other, (200, 200))
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.025  # 5 standard deviations of 40,000 pixels


def test_it_is_standard_normal_and_white() -> None:
    n = view_noise(0, "x", 0, (480, 640)).astype(np.float64)
    pixels = n.size
    assert abs(n.mean()) < 5 / np.sqrt(pixels)
    assert abs(n.std() - 1) < 5 / np.sqrt(2 * pixels)
    assert abs((np.abs(n) > 1.959964).mean() - 0.05) < 5 * np.sqrt(0.05 * 0.95 / pixels)
    for a, b in ((n[:, 1:], n[:, :-1]), (n[1:], n[:-1])):
        assert abs((a * b).mean()) < 5 / np.sqrt(pixels)


def test_sigma_scales_the_same_noise() -> None:
    depth = np.full((50, 60), 3, np.float32)
    noise = view_noise(0, "x", 0, depth.shape)
    for sigma in (0.01, 0.02, 0.03):
        recovered = (add_noise(depth, sigma, noise).astype(np.float64) / 3 - 1) / sigma
        np.testing.assert_allclose(recovered, noise, atol=2e-5)
    np.testing.assert_array_equal(add_noise(depth, 0.0, noise), depth)


DEPTHS = st.one_of(st.sampled_from([0.0, np.inf, TINY, 3.0]), st.floats(2.0**-10, 2.0**127, width=32))
NORMALS = st.floats(-10, 10, width=32)


@settings(max_examples=100, deadline=None)
@given(depth=arrays(np.float32, (2, 3, 4), elements=DEPTHS),
       noise=arrays(np.float32, (2, 3, 4), elements=NORMALS),
       sigma=st.floats(0, 2))
def test_free_missing_and_measured_pixels_stay_what_they_are(
    depth: np.ndarray, noise: np.ndarray, sigma: float
) -> None:
    before = depth.copy()
    noisy = add_noise(depth, sigma, noise)
    np.testing.assert_array_equal(depth, before)  # the input is not touched: views are shared by variants
    assert noisy.dtype == np.float32
    np.testing.assert_array_equal(noisy == 0, depth == 0)
    np.testing.assert_array_equal(np.isinf(noisy), np.isinf(depth))
    assert (noisy >= 0).all()  # and not NaN


def test_the_largest_errors_are_clipped_not_dropped() -> None:
    noisy = add_noise(np.array([[2.0, 2.0, 2.0]], np.float32), 0.5, np.array([[-2.0, -3.0, 1.0]], np.float32))
    np.testing.assert_array_equal(noisy, np.array([[TINY, TINY, 3.0]], np.float32))


@pytest.mark.parametrize("sigma", [-0.01, np.nan, np.inf])
def test_a_sigma_that_is_none(sigma: float) -> None:
    with pytest.raises(OcnfError, match="sigma"):
        add_noise(np.ones((2, 2), np.float32), sigma, np.zeros((2, 2), np.float32))


def test_noise_of_another_size() -> None:
    with pytest.raises(OcnfError, match="does not fit"):
        add_noise(np.ones((2, 2), np.float32), 0.1, np.zeros((2, 3), np.float32))
