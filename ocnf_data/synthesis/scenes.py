"""Procedural scenes in the grid's cube, and the cameras that see them: from within rooms, around tables.

A scene has its own coordinates (metres, z up). They are turned, scaled and moved into the cube,
`X = scale * rotation p + offset`, and with `zoom` the cube holds a part of the scene, about one of its
things. Cameras are chosen in the scene's coordinates, in real metres, and moved along. What is in a camera's
way is told by the boxes around the things, so that no camera stands under a table.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.manifest.synthesis import SceneCameras
from ocnf_data.meshes import Mesh
from ocnf_data.meshes.normalise import fit_cube
from ocnf_data.scenes.place import Draft
from ocnf_data.shapes.draw import Draw
from ocnf_data.synthesis.draw import Body, Look
from ocnf_data.views.trajectories import look_at, path_around, path_inside

_ROOM = "rooms"
_WALK = (0.9, 1.8)  # metres above the floor, of a sensor held in the hands
_PLACES = (0.2, 2.1)  # the same, of single cameras
_FROM_WALLS = (0.4, 0.2)  # metres that a walk, and a single camera, keep from the outside of the walls
_ROOM_MARGIN, _TABLE_MARGIN = 0.2, 0.06  # metres to the next box
_NEAREST = 0.6  # metres between a single camera and what it looks at: a sensor sees nothing nearer than 0.5
_AWAY = (0.55, 1.3)  # distance of a camera to what it sees on a table, in sides of the cube ...
_AT_LEAST = (0.6, 1.2)  # ... or in metres, where that is more
_LOWEST = np.sin(np.radians(5.0))  # of single cameras above a table, as sine of the elevation
_TRIES = 400  # per camera
_WATCHED = 0.5  # share of the walks through a room that keep what the cube holds in view


@dataclass(frozen=True, eq=False)
class PlacedScene:
    """A scene and where it stands in the cube.

    Attributes:
        body: which scene, and how it is turned, scaled and magnified.
        rotation: (3, 3), from the scene's directions to the cube's.
        scale: metres of the cube in one of the scene.
        offset: (3,) where the scene's origin stands in the cube, metres of the cube.
        side: side of the cube in metres of the scene.
        boxes: (N, 2, 3) lowest and highest corner of each thing, walls and floor included; scene.
    """

    body: Body
    rotation: F64
    scale: float
    offset: F64
    side: float
    boxes: F64

    @property
    def is_room(self) -> bool:
        """Whether it is a room, seen from inside; else a table."""
        return self.body.item.category == _ROOM

    @property
    def metres(self) -> float:
        """Real metres that a metre of the cube stands for."""
        return 1 / self.scale

    @property
    def bounds(self) -> tuple[F64, F64]:
        """Lowest and highest corner (3,) of the whole scene, metres of the scene."""
        return self.boxes[:, 0].min(axis=0), self.boxes[:, 1].max(axis=0)

    def into_cube(self, points: F64) -> F64:
        """Points (N, 3) of the scene in the cube."""
        moved: F64 = points @ (self.scale * self.rotation).T + self.offset
        return moved

    def out_of_cube(self, points: F64) -> F64:
        """Inverse of `into_cube`."""
        moved: F64 = (points - self.offset) @ self.rotation / self.scale
        return moved

    def cameras_into_cube(self, R: F64, T: F64) -> tuple[F64, F64]:
        """World-to-camera poses (n, 3, 3), (n, 3) of the scene as those of the cube; depth is scaled, too."""
        turned = R @ self.rotation.T
        return turned, self.scale * T - turned @ self.offset

    def clearance(self, points: F64) -> F64:
        """Distance of points (N, 3) of the scene to the nearest box, (N,) metres; 0 within one."""
        p = points[:, None]
        apart = np.maximum(np.maximum(self.boxes[:, 0] - p, p - self.boxes[:, 1]), 0)
        return np.asarray(np.linalg.norm(apart, axis=2).min(axis=1))


def place_scene(draft: Draft, mesh: Mesh, body: Body, extent: float, padding: float) -> PlacedScene:
    """Where a scene stands, for a body's rotation, scale and zoom.

    Without zoom it is normalised like a mesh. With it, the cube is smaller by that factor, and moved towards
    a chance point of a chance thing as far as it does not leave the scene's box for that.

    Args:
        draft: the things of the scene.
        mesh: their mesh, metres of the scene.
        body: the scene's rotation, scale and zoom.
        extent: side of the cube, metres.
        padding: share of it that stays free (see `meshes.normalise`).
    """
    rotation = np.eye(3) if body.rotation is None else body.rotation
    corners = np.array([(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part, _ in draft.parts])
    turned = mesh.vertices @ rotation.T
    whole = fit_cube(turned, mesh.faces, extent, padding)
    scale = whole.scale * body.scale * body.zoom
    low, high = turned.min(axis=0), turned.max(axis=0)
    centre = whole.centre
    if body.zoom > 1:
        which, *place = body.about
        first, last = corners[int(which * len(corners))]
        half = np.minimum(extent / scale, high - low) / 2
        centre = np.clip(rotation @ (first + np.array(place) * (last - first)), low + half, high - half)
    return PlacedScene(body, rotation, scale, -scale * centre, extent / scale, corners)


def truth_cameras(scene: PlacedScene, seed: int, n: int) -> tuple[F64, F64]:
    """R (n, 3, 3), T (n, 3) of the views of the ground truth: single cameras, a function of body and seed.

    Raises:
        OcnfError: there is hardly any free place for a camera (`crowded`).
    """
    body = scene.body
    draw = Draw("ocnf.synthesis.truth", seed, body.item.source, body.zoom, *body.about)
    return scene.cameras_into_cube(*_single(scene, draw, n))


def look_cameras(scene: PlacedScene, look: Look) -> tuple[F64, F64]:
    """R (k, 3, 3), T (k, 3) of the views of an input.

    Raises:
        OcnfError: there is no free path, or hardly any free place for a camera (`crowded`).
    """
    k, draw = len(look.views), Draw("ocnf.synthesis.scene_views", look.seed, look.key)
    if look.cameras is SceneCameras.SINGLE:
        return scene.cameras_into_cube(*_single(scene, draw, k))
    seen = _middle(scene)
    if not scene.is_room:
        poses = path_around(k, look.seed, look.key, seen.tolist(), _away(scene, draw), scene.clearance,
                            _TABLE_MARGIN)
    else:
        low, high = _within(scene, _FROM_WALLS[0], _WALK)
        poses = path_inside(k, look.seed, look.key, low.tolist(), high.tolist(), scene.clearance,
                            _ROOM_MARGIN, seen.tolist() if draw.chance(_WATCHED) else None)
    return scene.cameras_into_cube(*poses)


def _single(scene: PlacedScene, draw: Draw, n: int) -> tuple[F64, F64]:
    """Cameras in free places, each looking at a chance point of what the cube holds."""
    places, targets = [], []
    for _ in range(n * _TRIES):
        target = _some_point(scene, draw)
        place = _in_room(scene, draw) if scene.is_room else _above(scene, draw, target)
        margin = _ROOM_MARGIN if scene.is_room else _TABLE_MARGIN
        if np.linalg.norm(place - target) >= _NEAREST * 0.99 and scene.clearance(place[None])[0] >= margin:
            places.append(place)
            targets.append(target)
            if len(places) == n:
                return look_at(np.array(places), np.array(targets))
    raise OcnfError("there is no free place for a camera in a scene", code="crowded",
                    where=scene.body.item.source)


def _in_room(scene: PlacedScene, draw: Draw) -> F64:
    low, high = _within(scene, _FROM_WALLS[1], _PLACES)
    return np.array([draw.between(a, b) for a, b in zip(low, high, strict=True)])


def _above(scene: PlacedScene, draw: Draw, target: F64) -> F64:
    away, z, angle = _away(scene, draw), draw.between(_LOWEST, 1), draw.between(0, 2 * np.pi)
    ring = np.sqrt(1 - z * z)
    return np.asarray(target + away * np.array([ring * np.cos(angle), ring * np.sin(angle), z]))


def _away(scene: PlacedScene, draw: Draw) -> float:
    return draw.between(*(max(share * scene.side, least)
                          for share, least in zip(_AWAY, _AT_LEAST, strict=True)))


def _within(scene: PlacedScene, from_walls: float, heights: tuple[float, float]) -> tuple[F64, F64]:
    """The part of a room between two heights and away from the outside of its walls."""
    low, high = scene.bounds
    return np.array([*(low[:2] + from_walls), heights[0]]), np.array([*(high[:2] - from_walls), heights[1]])


def _middle(scene: PlacedScene) -> F64:
    """The middle of the cube, in the scene; at least on the scene's box."""
    return np.asarray(np.clip(scene.out_of_cube(np.zeros((1, 3)))[0], *scene.bounds))


def _some_point(scene: PlacedScene, draw: Draw) -> F64:
    """A point of the cube, moved onto the scene's box where it is outside of it."""
    half = scene.side * scene.scale / 2
    point = np.array([[draw.between(-half, half) for _ in range(3)]])
    return np.asarray(np.clip(scene.out_of_cube(point)[0], *scene.bounds))
