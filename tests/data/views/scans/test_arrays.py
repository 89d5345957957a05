"""Scans out of memory, agreement, and the colour of vertices."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import Colour, Scan
from ocnf_data.views.scans.agreement import Agreement, agreement, judge
from ocnf_data.views.scans.tum import associate
from ocnf_data.views.scans.vertex_colour import vertex_colours, vertex_normals

from .conftest import look

K = [[55.0, 0, 31.2], [0, 56.0, 23.4], [0, 0, 1]]
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def test_metres_and_millimetres(scene) -> None:
    exact = Scan.from_arrays(np.where(scene.depth == 0, np.nan, scene.depth), K, scene.poses)
    np.testing.assert_array_equal(exact.views.depth, scene.depth)
    whole = np.stack([scene.stored(i) for i in range(5)])
    whole[0, 0, 0] = 65535
    rounded = Scan.from_arrays(whole, K, scene.poses, depth_scale=1000)
    np.testing.assert_allclose(rounded.views.depth[1:], scene.depth[1:], atol=6e-4)
    assert rounded.views.depth[0, 0, 0] == 0 and rounded.warnings == ()
    with pytest.raises(OcnfError, match="no known unit"):
        Scan.from_arrays(whole, K, scene.poses)


def test_every_convention_of_poses(scene) -> None:
    plain = Scan.from_arrays(scene.depth, K, scene.poses).views
    inverse = np.linalg.inv(scene.poses)
    for poses, said in ((inverse, {"direction": "world-to-camera"}), (scene.poses @ FLIP, {"axes": "opengl"}),
                        (FLIP @ inverse, {"direction": "world-to-camera", "axes": "opengl"})):
        other = Scan.from_arrays(scene.depth, K, poses, **said).views
        np.testing.assert_allclose(other.R, plain.R, atol=1e-12)
        np.testing.assert_allclose(other.T, plain.T, atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_poses_that_are_not_finite_or_not_rigid_are_refused_by_name(scene, bad: float) -> None:
    poses = scene.poses.copy()
    poses[3, 0, 3] = bad
    with pytest.raises(OcnfError, match="third: the pose is not finite"):
        Scan.from_arrays(scene.depth, K, poses, names=["a", "b", "c", "third", "e"])
    poses[3] = np.diag([1.0, 1, 1.1, 1])
    with pytest.raises(OcnfError, match=r"frame 3.*not a rotation"):
        Scan.from_arrays(scene.depth, K, poses)


@pytest.mark.parametrize(("change", "message"), [
    ({"depth": np.zeros((5, 4))}, "not a stack"), ({"poses": np.eye(4)}, "poses do not fit"),
    ({"K": np.full((3, 3), np.nan)}, "not a pinhole"), ({"colour": np.zeros((5, 4, 4))}, "colour does not"),
    ({"colour": np.zeros((5, 64, 64, 3), np.uint8)}, "colour images are not the depth maps scaled"),
    ({"names": ["a"]}, "names do not fit"), ({"depth": np.full((5, 48, 64), -1.0)}, "negative"),
    ({"depth_scale": 0}, "depth_scale: not a scale"), ({"depth_scale": np.nan}, "depth_scale: not a scale"),
    ({"depth": np.ones((5, 48, 64), np.uint16), "depth_scale": 0.0}, "depth_scale: not a scale"),
    ({"depth_scale": -1000}, "depth_scale: not a scale"),
    ({"direction": "c2w"}, "direction: not a direction.*found c2w, expected camera-to-world or"),
    ({"depth": [np.ones((48, 64)), np.ones((24, 32))]},
     r"depth: not one array of numbers; found a list of shapes \(48, 64\), \(24, 32\), expected real num"),
    ({"colour": [np.zeros((48, 64, 3), np.uint8), np.zeros((24, 32, 3), np.uint8)]},
     r"colour: not one array of numbers; found a list of shapes \(48, 64, 3\), \(24, 32, 3\)"),
    ({"poses": [["a"]]}, "poses: not one array of numbers"),
    ({"K": "pinhole"}, "K: not one array of numbers"),
    ({"poses": [[1.0], [1.0, 2.0]]}, "poses: not one array of numbers"),
    ({"depth_scale": "1000"}, "depth_scale: not a scale; found 1000, expected a number"),
    ({"axes": "OpenGL"}, "axes: not a convention of axes.*found OpenGL, expected opencv or opengl")])
def test_arrays_that_do_not_fit(scene, change: dict[str, object], message: str) -> None:
    asked = {"depth": scene.depth, "K": K, "poses": scene.poses, **change}
    with pytest.raises(OcnfError, match=message):
        Scan.from_arrays(**asked)


def test_a_trajectory_in_millimetres_is_refused_and_one_frame_is_not(scene) -> None:
    poses = scene.poses.copy()
    poses[:, :3, 3] *= 1000
    with pytest.raises(OcnfError, match="look like millimetres"):
        Scan.from_arrays(scene.depth, K, poses)
    assert Scan.from_arrays(scene.depth[:1], K, poses[:1]).warnings == ()


@pytest.mark.parametrize("n", [6, 24])
def test_a_round_thing_on_a_turntable_is_not_taken_for_poses_the_wrong_way_round(n: int) -> None:
    """A ball in the origin looks the same in each frame: the poses the other way round agree entirely."""
    angles = 2 * np.pi * np.arange(n) / n
    poses = np.stack([look(0.8 * np.array([np.cos(a), np.sin(a), 0.3]), np.zeros(3)) for a in angles])
    inverse = np.linalg.inv(K)
    v, u = np.mgrid[:48, :64]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ inverse.T
    away = np.linalg.norm(poses[0, :3, 3])
    within = away**2 * rays[..., 2]**2 - (rays**2).sum(-1) * (away**2 - 0.25**2)
    near = (away * rays[..., 2] - np.sqrt(np.maximum(within, 0))) / (rays**2).sum(-1)
    depth = np.where(within > 0, near, 0)
    scan = Scan.from_arrays(np.tile(depth, (n, 1, 1)), K, poses)
    assert scan.agreement.inverse > scan.agreement.share + 0.1 and scan.agreement.past < 0.01
    assert scan.warnings == ()


def test_the_direction_is_named_only_where_the_other_one_agrees_well() -> None:
    views = wall([(0, 0, 0)] * 2).views
    for found, said in ((Agreement(5000, 0.4, 0.9, 0.0, 0.3), "other way round: 40 %"),
                        (Agreement(5000, 0.75, 0.99, 0.0, 0.1), "other way round: 75 %"),
                        (Agreement(5000, 0.4, 0.9, 0.0, 0.01), None),
                        (Agreement(5000, 0.4, 0.55, 0.0, 0.01), None),
                        (Agreement(5000, 0.4, 0.55, 0.0, 0.3), "see through each other's surfaces at 30 %"),
                        (Agreement(5000, 0.1, 0.55, 0.0, 0.3), "hardly agree with each other: 10 %"),
                        (Agreement(0, float("nan"), 0.9, 0.0, float("nan")), "nothing can be compared"),
                        (Agreement(0, float("nan"), 0.5, 0.0, float("nan")), "hardly overlap"),
                        (Agreement(0, *[float("nan")] * 4), "overlap (there is nothing that two")):
        assert [said is not None and said in warning for warning in judge(found, views, "here")] == [
            True] * (said is not None)


@pytest.mark.parametrize("factor", [0.2, 0.25, 0.5, 2, 4, 5])
def test_depth_of_another_unit_is_noticed_and_the_factor_named(factor: float, scene) -> None:
    right = Scan.from_arrays(scene.depth, K, scene.poses)
    assert right.agreement.factor == 1 and right.agreement.scaled == right.agreement.share
    wrong = Scan.from_arrays(scene.depth / np.float32(factor), K, scene.poses)
    assert wrong.agreement.factor == factor and wrong.agreement.scaled > 0.9
    (warning,) = wrong.warnings
    assert f"if depth were {factor:g} times as large, or translations {1 / factor:g} times" in warning


def test_axes_of_the_other_convention_are_noticed(scene) -> None:
    (warning,) = Scan.from_arrays(scene.depth, K, scene.poses, axes="opengl").warnings
    assert "axes of the cameras may be those of the other convention" in warning
    assert "with y and z reversed" in warning
    right = Scan.from_arrays(scene.depth, K, scene.poses @ FLIP, axes="opengl")
    assert right.warnings == () and right.agreement.flipped < 0.5


def test_frames_that_see_through_each_other_are_noticed() -> None:
    views = wall([(0, 0, 0)] * 2).views
    assert judge(Agreement(5000, 0.9, 0.5, 0.0, 0.079), views, "here") == []
    (warning,) = judge(Agreement(5000, 0.9, 0.5, 0.0, 0.081), views, "here")
    assert "see through each other's surfaces at 8 % of the depths" in warning


def test_depth_in_a_thousandth_of_its_unit_is_not_taken_for_poses_in_millimetres(scene) -> None:
    small = scene.depth / np.float32(1000)
    for scale in (1.0, 30.0, 0.001):
        poses = scene.poses.copy()
        poses[:, :3, 3] *= scale
        (warning,) = Scan.from_arrays(small, K, poses).warnings
        assert "depths look too small" in warning and "check the depth scale" in warning


def test_judging_the_frames_takes_no_copy_of_the_depth() -> None:
    views = Views(np.ones((40, 240, 320), np.float32), np.array(K), np.tile(np.eye(3), (40, 1, 1)),
                  np.zeros((40, 3)))
    tracemalloc.start()
    try:
        judge(agreement(views), views, "here")
        views.T[1] = 1000.0
        with pytest.raises(OcnfError, match="cameras spread over 1000 with depths of 1 m"):
            judge(Agreement(5000, 0.0, 0.0, 0.9, 0.5), views, "here")
        assert tracemalloc.get_traced_memory()[1] < views.depth.nbytes / 4
    finally:
        tracemalloc.stop()


def test_frames_that_do_not_overlap_confirm_nothing(scene) -> None:
    poses = scene.poses.copy()
    poses[:, 0, 3] += 100.0 * np.arange(5)
    (warning,) = Scan.from_arrays(np.minimum(scene.depth, 1000), K, poses).warnings
    assert "hardly overlap" in warning


def test_association_is_the_closest_first_and_each_once() -> None:
    assert associate([0.0, 1.0, 2.0], [2.01, 0.99, 5.0]) == [(1, 1), (2, 0)]
    assert associate([0.0, 0.010], [0.012]) == [(1, 0)]  # the nearer one has it
    assert associate([0.0, 0.02], [0.011, 0.031]) == [(1, 0)]  # which leaves 0.0 with nothing near enough
    assert associate([], [1.0]) == []
    rng = np.random.default_rng(0)
    a, b = np.sort(rng.uniform(0, 1, 60)), np.sort(rng.uniform(0, 1, 70))
    left, right, best = set(range(60)), set(range(70)), []
    while left and right:  # by brute force
        gap, i, j = min((abs(a[i] - b[j]), i, j) for i in left for j in right)
        if gap > 0.02:
            break
        best.append((i, j))
        left.remove(i)
        right.remove(j)
    assert associate(a, b) == sorted(best)


def wall(colours: list[tuple[int, int, int]]) -> Scan:
    """Frames of one colour each before a plane at z = 2."""
    n = len(colours)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(n)
    images = np.stack([np.full((96, 128, 3), colour, np.uint8) for colour in colours])
    return Scan.from_arrays(np.full((n, 48, 64), 2.0), K, poses, images)


def test_vertices_take_the_mean_of_what_sees_them() -> None:
    scan = wall([(200, 0, 40), (100, 0, 40)])
    points = np.array([[0.05, 0, 2.0], [0.05, 0, 2.5], [0, 0, -2.0], [99.0, 0, 2.0]])
    colours, seen = vertex_colours(points, scan, 0.05)
    assert seen.tolist() == [True, False, False, False]
    np.testing.assert_array_equal(colours[0], [150, 0, 40])
    np.testing.assert_array_equal(colours[1:], np.tile([150, 0, 40], (3, 1)))  # the nearest that is seen
    none, _ = vertex_colours(points[1:], scan, 0.05)
    assert (none == 128).all()


def test_the_view_that_looks_straight_counts_most() -> None:
    scan = wall([(200, 0, 0), (0, 0, 0)])
    straight = np.array([[0.0, 0, 2.0]])
    side = np.array([[-1.0, 0, -0.05]])
    facing, _ = vertex_colours(straight, scan, 0.05, np.array([[0, 0, -1.0]]))
    turned, _ = vertex_colours(straight, scan, 0.05, side / np.linalg.norm(side))
    assert facing[0, 0] == pytest.approx(100, abs=2) and turned[0, 0] < 140


def test_colour_is_where_it_was_painted(scene) -> None:
    """Vertices are pixels of one frame lifted into space: each has the colour of its pixel."""
    scan = Scan.from_arrays(scene.depth, K, scene.poses, scene.colour)
    lone = Scan(scan.views.subset([2]), ("2",), colour=Colour([scene.colour[2]], scan.colour.K[2:3]))
    v, u = np.nonzero(scene.depth[2])
    z = scene.depth[2][v, u].astype(np.float64)
    camera = np.stack([(u - 31.2) / 55 * z, (v - 23.4) / 56 * z, z], axis=1)
    points = (camera - scan.views.T[2]) @ scan.views.R[2]
    colours, seen = vertex_colours(points, lone, 0.01)
    assert seen[(u < 63) & (u > 0) & (v > 0) & (v < 47)].all()
    off = np.abs(colours[seen].astype(int) - scene.colour[2][v, u][seen])
    assert off.max() <= 1


def test_normals_of_a_box() -> None:
    from ocnf_data.shapes.primitives import ellipsoid

    part = ellipsoid(1, 1, 1, 40)
    normals = vertex_normals(part.vertices, part.faces)
    assert (normals * part.vertices).sum(axis=1).min() > 0.99
