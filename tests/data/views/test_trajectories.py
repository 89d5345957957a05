"""Paths are smooth, depend on seed and key alone, look where they should, and keep clear of geometry."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.render import render_depth
from ocnf_data.render.clearance import clearance
from ocnf_data.shapes.primitives import box, join
from ocnf_data.views.cameras import Views
from ocnf_data.views.trajectories import path_around, path_inside

LOW, HIGH = (-2.0, -1.5, 0.8), (2.0, 1.5, 1.9)


def around(n: int = 40, seed: int = 0, key: str = "a", **more: object) -> tuple[np.ndarray, np.ndarray]:
    return path_around(n, seed, key, (0.3, -0.2, 0.5), 2.0, **more)


def inside(n: int = 40, seed: int = 0, key: str = "a", **more: object) -> tuple[np.ndarray, np.ndarray]:
    return path_inside(n, seed, key, LOW, HIGH, **more)


def centres(R: np.ndarray, T: np.ndarray) -> np.ndarray:
    return -np.einsum("vji,vj->vi", R, T)


@pytest.mark.parametrize("path", [around, inside])
@pytest.mark.parametrize("n", [1, 2, 7, 300])
def test_any_number_of_cameras(path, n: int) -> None:
    R, T = path(n)
    Views(np.ones((n, 2, 2)), np.diag([1.0, 1, 1]), R, T)  # which checks the rotations
    assert R.shape == (n, 3, 3) and T.shape == (n, 3)


@pytest.mark.parametrize("path", [around, inside])
def test_they_depend_on_seed_and_key_alone(path) -> None:
    code = ("import sys; from ocnf_data.views.trajectories import path_around, path_inside; "
            "[sys.stdout.buffer.write(a.tobytes()) for a in (*path_around(9, 3, 'k', (0, 0, 0), 1.0), "
            "*path_inside(9, 3, 'k', (0, 0, 0), (1, 1, 1)))]")
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout
    here = [*path_around(9, 3, "k", (0, 0, 0), 1.0), *path_inside(9, 3, "k", (0, 0, 0), (1, 1, 1))]
    assert there == b"".join(array.tobytes() for array in here)
    first = centres(*path())
    for other in (path(seed=1), path(key="b")):
        assert np.linalg.norm(centres(*other) - first, axis=1).max() > 0.2


@pytest.mark.parametrize("path", [around, inside])
@pytest.mark.parametrize("seed", range(6))
def test_they_are_smooth(path, seed: int) -> None:
    """Ten times as many cameras are ten times nearer to each other and a hundred times straighter."""
    def steps(n: int) -> tuple[float, float, float]:
        R, T = path(n, seed)
        p = centres(R, T)
        turn = np.arccos(np.clip((np.einsum("vij,vij->v", R[1:], R[:-1]) - 1) / 2, -1, 1))
        return np.abs(np.diff(p, axis=0)).max(), np.abs(np.diff(p, n=2, axis=0)).max(), turn.max()

    (near, bend, turn), (nearer, straighter, slower) = steps(101), steps(1001)
    assert nearer < near / 9 and straighter < bend / 80 and slower < turn / 9
    assert turn < np.radians(12)  # a few degrees a frame at a hundred frames


@pytest.mark.parametrize("seed", range(6))
def test_around_looks_at_the_middle_from_above(seed: int) -> None:
    R, T = around(60, seed)
    p = centres(R, T) - (0.3, -0.2, 0.5)
    distance = np.linalg.norm(p, axis=1)
    assert (distance > 1.55).all() and (distance < 2.45).all() and (p[:, 2] > 0.1).all()
    x, y, z = np.einsum("vij,j->vi", R, [0.3, -0.2, 0.5]).T + T.T
    assert (np.hypot(x, y) / z < 0.3).all()
    assert (R[:, 1, 2] < 0).all()  # the image's down is the world's down
    azimuth = np.unwrap(np.arctan2(p[:, 1], p[:, 0]))
    assert 0.6 * 2 * np.pi - 0.01 < abs(azimuth[-1] - azimuth[0]) < 1.4 * 2 * np.pi + 0.01


@pytest.mark.parametrize("seed", range(6))
def test_inside_stays_inside_and_turns_all_around(seed: int) -> None:
    R, T = inside(200, seed)
    p = centres(R, T)
    assert (p >= LOW).all() and (p <= HIGH).all()
    yaw = np.unwrap(np.arctan2(R[:, 2, 1], R[:, 2, 0]))
    assert np.ptp(yaw) > np.radians(300) and (R[:, 1, 2] < -0.5).all()


def furnished() -> tuple[np.ndarray, np.ndarray]:
    room = join([box(5, 4, 2.5), *(box(0.5, 0.5, 2.4).move(x=x, y=y)
                                   for x in (-1.5, 0, 1.5) for y in (-1.1, 0.2, 1.2))])
    return room.vertices, room.faces


@pytest.mark.parametrize("seed", range(4))
def test_no_camera_is_in_or_near_geometry(seed: int) -> None:
    vertices, faces = furnished()
    free = clearance(vertices, faces)
    R, T = inside(30, seed, clearance=free, margin=0.2)
    K = np.array([[30.0, 0, 31.5], [0, 30, 23.5], [0, 0, 1]])
    assert render_depth(vertices, faces, K, R, T, (48, 64)).min() > 0.12  # z; the corners are 53 degrees off
    p = centres(R, T)
    for x in (-1.5, 0, 1.5):
        for y in (-1.1, 0.2, 1.2):  # exact distance to each pillar's footprint
            gap = np.maximum(np.abs(p[:, :2] - (x, y)) - 0.25, 0)
            assert np.hypot(*gap.T).min() > 0.19
    bare = centres(*inside(30, seed))
    assert any((np.abs(bare[:, :2] - (x, y)) < 0.45).all(axis=1).any()
               for x in (-1.5, 0, 1.5) for y in (-1.1, 0.2, 1.2))  # else nothing was tested


def test_a_path_around_is_widened_until_it_is_free() -> None:
    middle, half = np.array([0.3, -0.2, 0.5]), 1.6
    part = box(2 * half, 2 * half, 2 * half).move(x=0.3, y=-0.2, z=0.5 - half)

    def gaps(**more: object) -> list[float]:
        """From each camera to the box: 0 within it."""
        p = np.concatenate([centres(*around(30, seed, **more)) for seed in range(8)])
        return np.linalg.norm(np.maximum(np.abs(p - middle) - half, 0), axis=1)

    assert gaps().min() == 0
    assert gaps(clearance=clearance(part.vertices, part.faces), margin=0.3).min() > 0.28


def test_within_something_there_is_no_room() -> None:
    part = join([box(6, 6, 6).move(z=-3), box(1, 1, 1).move(x=1, z=-0.5)])
    points = np.array([[1.0, 0, 0], [-1, 0, 0]])
    np.testing.assert_allclose(clearance(part.vertices, part.faces)(points), [0.5, 1.5], atol=0.01)
    np.testing.assert_allclose(clearance(part.vertices, part.faces, 1.0)(points), [0, 1.5], atol=0.01)


def test_a_place_without_room_is_said_to_be() -> None:
    part = box(40, 40, 40).move(z=-20)
    wall = join([part] + [box(39, 39, 0.01).move(z=z) for z in np.arange(-3, 4, 0.1)])
    with pytest.raises(OcnfError, match="no path inside is free") as caught:
        inside(clearance=clearance(wall.vertices, wall.faces), margin=0.2)
    assert caught.value.code == "crowded"


def test_clearance_of_a_sphere() -> None:
    from ocnf_data.shapes.primitives import ellipsoid

    part = ellipsoid(1, 1, 1, 60)
    points = np.array([[0, 0, 0], [0.5, 0.1, 0], [0, 2.0, 0], [1.5, 1.5, 1.5]])
    found = clearance(part.vertices, part.faces)(points)
    np.testing.assert_allclose(found, np.abs(np.linalg.norm(points, axis=1) - 1), atol=0.02)
    assert np.isinf(clearance(part.vertices[:3] + 99, np.array([[0, 0, 0]]))(points)).all()


@pytest.mark.parametrize("wrong", [{"n": 0}, {"n": 10**6}, {"margin": 0.0}, {"margin": np.nan}])
def test_impossible_wishes(wrong: dict[str, object]) -> None:
    for path in (around, inside):
        with pytest.raises(OcnfError):
            path(**wrong)
