"""Rigs: the directions of SEMANTICS 1 to the letter, and cameras that look at the origin."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocnf_data import Views
from ocnf_data.errors import OcnfError
from ocnf_data.views.rigs import (
    icosphere,
    intrinsics,
    look_from,
    published80,
    rig_from_name,
    view_subset,
)

RIGS = {"published80": 80, "icosphere0": 20, "icosphere1": 80, "icosphere2": 320, "fibonacci1": 1,
        "fibonacci100": 100}


@pytest.mark.parametrize(("name", "n"), RIGS.items())
def test_directions_are_distinct_unit_vectors(name: str, n: int) -> None:
    t = rig_from_name(name)
    assert t.shape == (n, 3)
    np.testing.assert_allclose(np.linalg.norm(t, axis=1), 1.0, atol=1e-15)
    gaps = np.linalg.norm(t[:, None] - t[None], axis=-1) + 2 * np.eye(n)
    assert gaps.min() > 0.05


def test_published_directions_by_hand() -> None:
    # Face 0 is (south pole, lower ring at 108 deg, lower ring at 36 deg); written out with plain numbers.
    lat = np.deg2rad(26.56505117707799)
    south = np.array([0.0, 0.0, -1.0])
    p36, p108 = (
        np.array([np.cos(lat) * np.cos(phi), np.cos(lat) * np.sin(phi), -np.sin(lat)])
        for phi in np.deg2rad([36, 108])
    )
    s = 2**-0.5
    expected = [
        south + s * south + s * p36,
        s * south + p108 + s * p108,
        s * p36 + s * p108 + p36,
        s * p36 + s * south + s * p108,
    ]
    expected = [v / np.linalg.norm(v) for v in expected]
    np.testing.assert_allclose(published80()[:4], expected, atol=1e-15)


def test_published_directions_golden() -> None:
    """Frozen: view numbers, and with them subsets and noise, hang on this order."""
    golden = {
        0: (0.241366378707745, 0.175362938961825, -0.954458019437304),
        26: (-0.881055236542850, 0.423363585579242, 0.210961950516935),
        52: (-0.463941787385064, -0.860379610028063, -0.210961950516935),
        79: (0.491123473188423, -0.356822089773090, 0.794654472291766),
    }
    for view, direction in golden.items():
        np.testing.assert_allclose(published80()[view], direction, atol=1e-12)


def test_icosphere_is_symmetric_and_even() -> None:
    t = icosphere(1)
    np.testing.assert_allclose(t.sum(axis=0), 0.0, atol=1e-12)
    antipodes = np.linalg.norm(t[:, None] + t[None], axis=-1).min(axis=1)
    np.testing.assert_allclose(antipodes, 0.0, atol=1e-12)
    nearest = [np.sort(u @ u.T, axis=1)[:, -2] for u in (t, published80())]  # cosine to the next direction
    spread = [np.rad2deg(np.arccos(c.min()) - np.arccos(c.max())) for c in nearest]
    assert spread[0] < 1 < spread[1]  # the published slip spaces its directions unevenly


DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda t: np.linalg.norm(t) > 1e-3)


POLES = st.sampled_from([(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (-0.0, 0.0, -1.0), (1e-9, 0.0, -1.0)])


@given(st.one_of(DIRECTIONS, POLES), st.floats(0.1, 10))
def test_cameras_look_at_the_origin(direction: tuple[float, float, float], distance: float) -> None:
    t = np.array([direction]) / np.linalg.norm(direction)
    (R,), (T,) = look_from(t, distance)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-12)
    # The origin is on the optical axis at depth `distance` ...
    np.testing.assert_array_equal(R @ np.zeros(3) + T, [0, 0, distance])
    # ... and the centre, on the sphere of that radius, is where the module says: t mirrored in z.
    np.testing.assert_allclose(-R.T @ T, distance * t[0] * [1, 1, -1], atol=1e-12 * distance)
    # Undo the half turn: what is left takes (0, 0, 1) to t by the angle between them and no more.
    A = np.diag([-1.0, -1.0, 1.0]) @ R
    np.testing.assert_allclose(A @ [0, 0, 1], t[0], atol=1e-12)
    assert np.trace(A) == pytest.approx(1 + 2 * t[0, 2], abs=1e-12)


def test_view_subsets() -> None:
    assert view_subset(80, 1).tolist() == [0]
    assert view_subset(80, 4).tolist() == [0, 26, 52, 79]
    for k in range(1, 81):
        np.testing.assert_array_equal(view_subset(80, k), np.linspace(0, 79, k).astype(int))
    np.testing.assert_array_equal(view_subset(320, 320), np.arange(320))


def test_intrinsics() -> None:
    np.testing.assert_array_equal(intrinsics(351, 352, 320, 240), [[351, 0, 320], [0, 352, 240], [0, 0, 1]])


@pytest.mark.parametrize("name", ["published81", "icosphere", "icosphere6", "icosphere-1", "fibonacci0",
                                  "fibonacci01", "fibonacci99999999999", "", "Published80"])
def test_unknown_rigs_are_refused(name: str) -> None:
    with pytest.raises(OcnfError, match=r"^rig: "):
        rig_from_name(name)


def test_bad_poses_and_subsets_are_refused() -> None:
    with pytest.raises(OcnfError, match="directions"):
        look_from(np.zeros((1, 3)), 3.0)
    with pytest.raises(OcnfError, match="directions"):
        look_from(np.array([0.0, 0.0, 1.0]), 3.0)
    with pytest.raises(OcnfError, match="distance"):
        look_from(published80(), 0.0)
    for k in (0, 81):
        with pytest.raises(OcnfError, match="views"):
            view_subset(80, k)


def test_views_by_number_or_mask() -> None:
    depth = np.arange(1.0, 4.0, dtype=np.float32)[:, None, None] * np.ones((3, 2, 2), np.float32)
    views = Views(depth, np.eye(3), *look_from(published80()[:3], 3.0))
    for chosen, expected in (([2, 0], [3, 1]), (np.array([False, True, True]), [2, 3]),
                             ([True, False, False], [1]), (np.array([-1], np.int8), [3])):
        assert views.subset(chosen).depth[:, 0, 0].tolist() == expected
    for wrong in ([0.9, 1.9], [3], [-4], [True, False], [[0]], ["0"], 1, None):
        with pytest.raises(OcnfError, match="indices: no such views"):
            views.subset(wrong)
