"""The cube: what is fused in it is what would be fused of the scan where it stands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data import GridOctree, Views, fuse_tsdf
from ocnf_data.errors import OcnfError
from ocnf_data.octree.surface import octree_surface
from ocnf_data.sequences.cube import box_of_cube, into_cube, object_box, placed
from ocnf_data.sequences.known import known_surface
from ocnf_data.views.scans import read_scan

from .conftest import BALL, RADIUS, REGION, ROOM, SIZE, K, cast, poses

COORDINATE = st.floats(-0.9, 0.9)


def views(n: int) -> Views:
    R, T = poses(n)
    depth = np.stack([cast(*camera) for camera in zip(R, T, strict=True)]).astype(np.float32)
    depth[:, ::7, ::5] = 0
    return Views(depth, K, R, T)


@settings(max_examples=25, deadline=None)
@given(corner=st.tuples(COORDINATE, COORDINATE, COORDINATE), edges=st.tuples(*[st.floats(0.05, 2.5)] * 3),
       extent=st.sampled_from([1.0, 3.0, 7.5]), padding=st.sampled_from([0.0, 0.05, 0.3]))
def test_moving_the_scan_is_moving_the_cube(corner: tuple[float, ...], edges: tuple[float, ...],
                                            extent: float, padding: float) -> None:
    box = (*corner, *np.add(corner, edges).tolist())
    place, seen = into_cube(box, extent, padding), views(3)
    size, centre = extent / place.scale, tuple(place.centre.tolist())
    assert size * (1 - padding) == pytest.approx(max(edges))
    np.testing.assert_allclose(centre, np.add(corner, np.array(edges) / 2))
    there = fuse_tsdf(seen, 16, size, centre=centre).to_dense()
    here = fuse_tsdf(placed(seen, place), 16, extent).to_dense()
    assert (np.abs(there - here) > 1e-4).mean() < 2e-3  # but where a projection is a rounding tie


def test_free_rays_and_missing_measurements_stay_what_they_are() -> None:
    depth = np.array([[[np.inf, 0.0, 2.0]]], np.float32)
    moved = placed(Views(depth, np.diag([1.0, 1, 1]), np.eye(3)[None], np.zeros((1, 3))),
                   into_cube((0, 0, 0, 1, 1, 1), 3.0, 0.0))
    assert moved.depth.tolist() == [[[np.inf, 0.0, 6.0]]]


def test_the_box_of_a_cube_gives_the_cube_back() -> None:
    place = into_cube(box_of_cube(((1, 2, 3), 0.5), 0.05), 3.0, 0.05)
    assert place.scale == pytest.approx(6) and place.centre == pytest.approx([1, 2, 3])


def test_the_largest_object_is_the_room_of_the_scene() -> None:
    """Ball and walls touch nowhere; the walls are the larger. Within the truncation and a voxel."""
    box = np.array(object_box(views(30))).reshape(2, 3)
    assert (box[0] < ROOM[0] + 0.1).all() and (box[1] > ROOM[1] - 0.1).all()
    assert (np.abs(box - ROOM) < 0.2).all()


def test_nothing_measured_is_no_object() -> None:
    nothing = Views(np.zeros((1, *SIZE)), K, np.eye(3)[None], np.zeros((1, 3)))
    with pytest.raises(OcnfError, match=r"nothing was measured.*Check the depth scale") as refused:
        object_box(nothing)
    assert "--" not in str(refused.value)  # `ocnf-data` has no such options, and Python none at all


def test_the_known_surface_is_the_scene_without_walls_around_the_unknown(scans: Path) -> None:
    place = into_cube(tuple(REGION), 3.0, 0.05)
    seen = placed(read_scan(scans / "long", depth_scale=10_000).views.subset([2, 3, 4]), place)
    tsdf = fuse_tsdf(seen, 64)
    vertices, faces = known_surface(tsdf, 3.0)
    points = place.invert(vertices)
    walls = np.minimum(points - ROOM[0], ROOM[1] - points).min(axis=1)
    off = np.minimum(np.abs(np.linalg.norm(points - BALL, axis=1) - RADIUS), np.abs(walls))
    voxel = 3.0 / 64 / place.scale
    assert len(faces) > 500 and faces.max() < len(vertices)
    assert (off < 1.5 * voxel).mean() > 0.9  # the rest: silhouettes, where free meets known
    whole = place.invert(octree_surface(tsdf, 3.0)[0])
    closed = np.minimum(np.abs(np.linalg.norm(whole - BALL, axis=1) - RADIUS),
                        np.abs(np.minimum(whole - ROOM[0], ROOM[1] - whole).min(axis=1)))
    assert (closed < 1.5 * voxel).mean() < 0.8


def test_a_solid_that_the_border_cuts_is_not_closed_there() -> None:
    """A plane between z = 30 and 31 of 32 voxels, behind which the last voxel is still in the band."""
    depth = np.broadcast_to(np.arange(32)[:, None, None], (32, 32, 32))
    tsdf = GridOctree.from_dense(np.clip((30.5 - depth) / 2, -1, 1).astype(np.float32)[None], 0.0)
    vertices, faces = known_surface(tsdf, 32.0)
    np.testing.assert_allclose(vertices[:, 2], 15.0, atol=1e-6)  # 30.5 + 1/2 - 16
    assert len(faces) == 2 * 31**2
    assert octree_surface(tsdf, 32.0)[0][:, 2].max() > 15.5


def test_what_is_known_may_be_said_by_another_volume() -> None:
    """A ball that a network completes, of which the reference knows the half with x > 0 alone."""
    axis = (np.arange(32) + 0.5) / 32 - 0.5
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    ball = np.clip((np.sqrt(x**2 + y**2 + z**2) - 0.3) * 15, -0.99, 1).astype(np.float32)
    half = np.where(x > 0, ball, -1).astype(np.float32)
    whole, known = (GridOctree.from_dense(field[None], 0.0) for field in (ball, half))
    vertices, faces = known_surface(whole, 1.0, known)
    assert len(faces) > 100 and vertices[:, 0].min() >= 0
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.3, atol=0.02)
    assert len(known_surface(whole, 1.0)[0]) == len(octree_surface(whole, 1.0)[0])
