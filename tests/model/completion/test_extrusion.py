"""Extrusion of a box and a cylinder that stand on a table, of which two sides and the top are seen."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ocnf_model.completion.extrusion import extrude, main_direction, points_and_normals, sweep
from ocnf_model.completion.scores import Scores
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import Visible


def test_a_sweep_goes_on_through_what_is_hidden_and_stops_at_free_space() -> None:
    surface, hidden = (np.array([[[int(c) for c in row]]], bool) for row in ("0100010", "0011001"))
    np.testing.assert_array_equal(sweep(surface, hidden, 2)[0, 0], [0, 1, 1, 1, 0, 1, 1])
    turned = sweep(np.moveaxis(surface, 2, 0), np.moveaxis(hidden, 2, 0), 0)
    np.testing.assert_array_equal(turned[:, 0, 0], [0, 1, 1, 1, 0, 1, 1])


def test_points_lie_on_solids_and_normals_at_right_angles_to_them(tabletop: Callable[..., Tabletop]) -> None:
    points, normals = points_and_normals(tabletop().view)
    front = (np.abs(points[:, 1] - 0.1) < 1e-3) & (points[:, 2] > 0.08) & (points[:, 2] < 0.17) \
        & (points[:, 0] > 0.1) & (points[:, 0] < 0.18)
    assert front.sum() > 200
    np.testing.assert_allclose(np.abs(normals[front]), np.tile([0, 1.0, 0], (front.sum(), 1)), atol=1e-2)
    assert points[:, 2].min() > 0.05 - 1e-4


def test_the_main_direction_is_that_of_the_sides() -> None:
    for degrees in (1, 31, 45, 89):
        angles = np.radians(degrees + 90 * np.arange(4))
        sides = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1).repeat(50, axis=0)
        top = np.tile([0, 0, 1.0], (1000, 1))
        found = np.degrees(main_direction(np.concatenate([sides, top, np.zeros((5, 3))])))
        assert min(abs(found - degrees), 90 - abs(found - degrees)) <= 2


def test_solids_are_filled_from_the_sides_that_are_seen(tabletop: Callable[..., Tabletop],
                                                     inside: dict[str, np.ndarray]) -> None:
    scene = tabletop()
    visible = Visible.of(scene.view, scene.shape, scene.voxel)
    found, band = extrude(scene), visible.tsdf < 0
    scores = Scores.of(scene.occupied, found, visible.judged)
    assert scores.iou > 0.75 > 0.5 > Scores.of(scene.occupied, band, visible.judged).iou
    for part in inside.values():
        assert found[part & visible.judged].mean() > 0.95 > 0.5 > band[part & visible.judged].mean()


def test_where_nothing_stands_nothing_grows(tabletop: Callable[..., Tabletop]) -> None:
    scene = tabletop()
    flat = np.where(np.isfinite(scene.view.depth), 0, scene.view.depth).astype(np.float32)
    empty = Tabletop("empty", scene.view.with_depth(flat), scene.voxel, scene.tsdf)
    assert not extrude(empty).any()
