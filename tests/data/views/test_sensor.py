"""The sensor's noise has the moments that its papers give, and depends on (seed, key, view) alone."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.views.sensor import SensorDraws, _angle, add_sensor_noise, sensor_draws

SIZE = (240, 320)
K = np.array([[585.0, 0, 160], [0, 585, 120], [0, 0, 1]])
STEPS = 351.3

GOLDEN = np.array([0x3fc85bb6, 0x3f183204, 0x3e702400, 0x3e4076ac], np.uint32)
GOLDEN_ROW = [1.3940, 0.9008, 0.9008, 0.8985, 0.9008, 0.9008, 1.5613]


def wall(z: float, size: tuple[int, int] = SIZE) -> np.ndarray:
    return np.full(size, z, np.float32)


def tilted(z: float, degrees: float, size: tuple[int, int] = SIZE, f: float = 585.0) -> np.ndarray:
    """A plane through (0, 0, z), turned about the camera's y axis."""
    x = (np.arange(size[1]) - size[1] / 2) / f
    return np.tile(z / (1 - x * np.tan(np.radians(degrees))), (size[0], 1)).astype(np.float32)


def sense(depth: np.ndarray, strength: float = 1.0, metres: float = 1.0, view: int = 0,
          f: float = 585.0) -> np.ndarray:
    k = np.array([[f, 0, depth.shape[1] / 2], [0, f, depth.shape[0] / 2], [0, 0, 1]])
    return add_sensor_noise(depth, k, sensor_draws(0, "x", view, depth.shape), strength, metres)


def nguyen(z: float, degrees: float = 0) -> float:
    sigma, t = 0.0012 + 0.0019 * (z - 0.4) ** 2, np.radians(degrees)
    return sigma + (0.0001 / np.sqrt(z) * t**2 / (np.pi / 2 - t) ** 2 if degrees > 60 else 0)


def test_golden_values() -> None:
    """Fails if numpy ever changes its streams: data sets would no longer be the same."""
    draws = sensor_draws(0, "chair_0001", 26, (480, 640))
    assert draws.normal.dtype == draws.uniform.dtype == np.float32
    ends = np.array([draws.normal[0, 0, 0], draws.normal[3, 479, 639], draws.uniform[0, 0, 0],
                     draws.uniform[1, 479, 639]]).view(np.uint32)
    np.testing.assert_array_equal(ends, GOLDEN)


def test_a_golden_view() -> None:
    """To half a millimetre: one step of disparity is 6 mm at 1.5 m."""
    depth = tilted(1.5, 30, (24, 32), 60)
    depth[8:16, 10:20] = 0.9
    depth[:, 28:] = np.inf
    noisy = sense(depth, f=60)
    np.testing.assert_allclose(noisy[12, 8:22:2], GOLDEN_ROW, atol=5e-4)


def test_the_same_in_another_process_and_order() -> None:
    here = {view: sense(wall(2, (12, 16)), view=view) for view in (5, 0, 3)}
    code = ("import sys, numpy as np; from ocnf_data.views.sensor import add_sensor_noise, sensor_draws; "
            "K = np.array([[585.0, 0, 8], [0, 585, 6], [0, 0, 1]]); z = np.full((12, 16), 2, np.float32); "
            "[sys.stdout.buffer.write(add_sensor_noise(z, K, sensor_draws(0, 'x', v, z.shape)).tobytes()) "
            "for v in (0, 3, 5)]")
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    assert there == b"".join(here[view].tobytes() for view in (0, 3, 5))


@pytest.mark.parametrize("other", [(1, "x", 0), (0, "y", 0), (0, "x", 1)])
def test_every_part_of_the_name_counts(other: tuple[int, str, int]) -> None:
    a, b = sensor_draws(0, "x", 0, (99, 99)), sensor_draws(*other, (99, 99))
    assert abs(np.corrcoef(a.normal.ravel(), b.normal.ravel())[0, 1]) < 0.03


def test_no_strength_is_no_noise() -> None:
    depth = tilted(1.5, 70)
    depth[5, 5], depth[7, 7], depth[90:, :90] = 0, np.inf, 9
    np.testing.assert_array_equal(sense(depth, 0.0), depth)


@pytest.mark.parametrize("z", [0.8, 1.5, 2.5, 4.0])
@pytest.mark.parametrize("strength", [0.5, 1.0, 2.0])
def test_a_wall_has_nguyens_deviation(z: float, strength: float) -> None:
    noisy = np.concatenate([sense(wall(z), strength, view=view) for view in range(4)]).astype(np.float64)
    assert (noisy > 0).all()
    assert abs(noisy.mean() - z) < 0.1 * strength * nguyen(z)
    assert noisy.std() == pytest.approx(strength * nguyen(z), rel=0.06)


def test_a_grazing_wall_is_noisier_by_nguyens_third_term_and_has_holes() -> None:
    depth = tilted(2.0, 78)
    middle = np.s_[:, 130:190]  # the rays there meet the plane at 75 to 81 degrees
    off, holes = [], []
    for view in range(6):
        noisy = sense(depth, view=view)[middle].astype(np.float64)
        seen = noisy > 0
        off.append((noisy - depth[middle])[seen])
        holes.append(1 - seen.mean())
    assert np.concatenate(off).std() == pytest.approx(nguyen(2.0, 78), rel=0.12)
    assert np.mean(holes) == pytest.approx(((78 - 60) / 30) ** 2, abs=0.06)
    assert (sense(tilted(2.0, 45)) > 0).all()


@settings(max_examples=60, deadline=None)
@given(turn=st.floats(0, 84), about=st.floats(0, 360), u=st.integers(0, 19), v=st.integers(0, 14))
def test_the_angle_is_that_of_the_plane(turn: float, about: float, u: int, v: int) -> None:
    a, b = np.radians([turn, about])
    normal = np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])
    k = np.array([400.0, 380.0, 9.0, 7.0])
    y, x = np.mgrid[:15, :20]
    rays = np.stack([(x - k[2]) / k[0], (y - k[3]) / k[1], np.ones((15, 20))], axis=-1)
    depth = (1.5 / (rays @ normal)).astype(np.float32)
    ray = rays[v, u]
    expected = np.degrees(np.arccos(ray @ normal / np.linalg.norm(ray)))
    found = np.degrees(_angle(depth, k, v, u))
    assert found == pytest.approx(min(expected, 85), abs=0.5)


@pytest.mark.parametrize(("strength", "metres"), [(1.0, 1.0), (2.0, 1.0), (1.0, 0.4)])
def test_depths_are_whole_steps_of_disparity(strength: float, metres: float) -> None:
    noisy = sense(wall(2.0), strength, metres).astype(np.float64)
    disparity = STEPS / strength / (noisy[noisy > 0] * metres)
    np.testing.assert_allclose(disparity, np.rint(disparity), atol=2e-4 * disparity.max() / 100)
    assert len(np.unique(np.rint(disparity))) > 3


def test_nothing_is_measured_out_of_range() -> None:
    assert (sense(wall(0.45)) == 0).all() and (sense(wall(5.05)) == 0).all()
    assert (sense(wall(0.6)) > 0).all() and (sense(wall(4.9)) > 0).all()
    assert (sense(wall(3.0), metres=0.1) == 0).all() and (sense(wall(30.0), metres=0.1) > 0).all()
    assert (sense(wall(5.05), 0.3) == 0).mean() == pytest.approx(0.3, abs=0.08)


def test_metres_scale_the_world() -> None:
    depth = tilted(1.2, 65)
    depth[50:90, 100:150] = 0.9
    np.testing.assert_allclose(sense(depth * 4, metres=0.25) / 4, sense(depth), rtol=1e-5)


def test_free_and_missing_pixels_stay_away_from_edges() -> None:
    depth = np.full(SIZE, np.inf, np.float32)
    depth[60:180, 80:240], depth[100:120, 100:140] = 1.5, 0
    noisy = sense(depth)
    assert np.isinf(noisy[:50]).all() and np.isinf(noisy[:, :70]).all()
    assert (noisy[100:120, 100:140] == 0).all()  # nothing fills a hole
    edge = np.isinf(noisy[60:180, 80:240])
    assert edge.any() and not edge[10:-10, 10:-10].any()  # edges are ragged both ways
    assert np.isfinite(noisy[50:60, 90:230]).any()


def test_edges_are_ragged_by_nguyens_pixels_and_some_pixels_fly() -> None:
    depth = wall(2.0)
    depth[:, 160:] = 1.0  # the near part to the right; no shadow falls on a half that is left of nothing else
    swapped, flying = np.zeros(320), 0
    for view in range(4):
        noisy = sense(depth, view=view)
        left, measured = noisy[:, :160], noisy > 0
        swapped[:160] += ((left > 0) & (left < 1.1)).sum(axis=0)
        swapped[160:] += (noisy[:, 160:] > 1.9).sum(axis=0)
        flying += (measured & (noisy > 1.1) & (noisy < 1.9))[:, 158:162].sum()
    share = swapped / (4 * 240)
    assert share[160] == pytest.approx(0.266, abs=0.06)  # P(n < -0.5 / 0.8): half a pixel rounds to one
    assert share[161] == pytest.approx(0.030, abs=0.03)
    assert (share[165:] == 0).all() and (share[:155] == 0).all()
    assert 0.01 < flying / (4 * 240 * 2) < 0.08


def test_the_projectors_shadow_lies_to_the_left() -> None:
    depth = wall(2.0)
    depth[100:140, 200:260] = 1.0
    width = 585 * 0.075 * (1 / 1.0 - 1 / 2.0)  # 21.9 pixels
    holes = np.mean([sense(depth, view=view) == 0 for view in range(8)], axis=0)[105:135]
    assert holes[:, int(200 - width) + 4 : 195].mean() == pytest.approx(0.4, abs=0.08)
    assert (holes[:, : int(200 - width) - 4] == 0).all() and (holes[:, 265:] == 0).all()


def test_neighbours_share_their_noise_within_the_window_and_not_beyond() -> None:
    n = sense(wall(4.0), 2.0).astype(np.float64) - 4
    n -= n.mean()

    def lag(k: int) -> float:
        return float((n[:, k:] * n[:, :-k]).mean() / n.var())

    assert lag(1) > 0.6 and 0.2 < lag(4) < 0.7 and abs(lag(12)) < 0.12


@pytest.mark.parametrize(("change", "message"), [
    ({"strength": -1.0}, "strength"), ({"strength": np.nan}, "strength"), ({"metres": 0.0}, "metres"),
    ({"draws": SensorDraws(np.zeros((4, 2, 2), np.float32), np.zeros((2, 2, 2), np.float32))}, "draws")])
def test_bad_arguments(change: dict[str, object], message: str) -> None:
    asked = {"depth": wall(1.0), "K": K, "draws": sensor_draws(0, "x", 0, SIZE), **change}
    with pytest.raises(OcnfError, match=message):
        add_sensor_noise(**asked)


