"""What a sample is made of: a pure function of (seed, epoch, number), drawn with raw doubles of Philox.

A sample is a *body*, which decides the ground truth (mesh, rotation, scale), seen in a *look*, which decides
the input (cameras, noise). With `repeat: k` a body lasts for k epochs, a *season*; looks are always new.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.generation.procedural import procedural_name
from ocnf_data.generation.records import Item
from ocnf_data.manifest.synthesis import Directions, Rotate, SceneCameras
from ocnf_data.scenes import SCENES
from ocnf_data.shapes.draw import Draw
from ocnf_data.synthesis.sources import Pool, Sources
from ocnf_data.views.noise import NoiseModel
from ocnf_data.views.rigs import rig_from_name, view_subset

T = TypeVar("T")
_SHAPES = 2**48 - 1  # so many of a category and split can be drawn; what a double holds exactly
_SHAPES_UP = "z"


@dataclass(frozen=True, eq=False)
class Body:
    """What is looked at.

    Attributes:
        item: the mesh file, or the procedural shape or scene.
        rotation: (3, 3), applied to the vertices before they are normalised; None leaves them as they are.
        scale: factor after that, at most 1.
        zoom: of a scene, a factor beside `scale`, at least 1.
        about: of a scene, what the cube is moved to if `zoom` is above 1: (which thing, x, y, z), shares from
            0 to 1 of the list of things and of the thing's box.
    """

    item: Item
    rotation: F64 | None = None
    scale: float = 1.0
    zoom: float = 1.0
    about: tuple[float, ...] = ()

    @property
    def is_scene(self) -> bool:
        """Whether it is a procedural scene, which has cameras of its own."""
        return self.item.index is not None and self.item.category in SCENES


@dataclass(frozen=True, eq=False)
class Look:
    """How an input sees it.

    Attributes:
        directions: (k, 3) directions of the cameras, as rigs have them; None where only scenes are drawn.
        views: what tells the noise of one view from another's: numbers in the rig, or 0 .. k-1.
        noise: model of the noise.
        sigma: standard deviation of the noise of `park`, as a fraction of the depth.
        strength: strength of the noise of `kinect`: 0 is none, 1 that of the sensor.
        seed, key: what the noise depends on beside the view (see `views.noise`).
        cameras: how cameras are chosen in a scene, instead of `directions`.
        background: whether rays that meet nothing of a scene count as free space, as if there were something
            farther off; else they measure nothing.
        misaligned: standard deviation of the error of the poses, in voxels of the finest resolution.
    """

    directions: F64 | None
    views: tuple[int, ...]
    noise: NoiseModel
    seed: int
    key: str
    sigma: float = 0.0
    strength: float = 1.0
    cameras: SceneCameras = SceneCameras.SINGLE
    background: bool = True
    misaligned: float = 0.0


def season_of(epoch: int, repeat: int) -> int:
    """Number of the season that an epoch lies in."""
    return epoch // repeat


def draw_body(sources: Sources, seed: int, season: int, number: int, attempt: int = 0) -> Body:
    """The body of sample `number` in a season; `attempt` counts the bad meshes that were drawn before."""
    settings = sources.settings
    draw = Draw("ocnf.synthesis.body", seed, season, number, attempt)
    pool = _pick(draw, [(pool, pool.weight) for pool in sources.pools])
    item, up = _pick_item(draw, pool, sources.split), settings.up if pool.items else _SHAPES_UP
    rotation = None
    match _pick_name(draw, settings.rotate):
        case Rotate.ANY:
            rotation = _any_rotation(draw)
        case Rotate.UPRIGHT:
            rotation = _turn(up, draw.between(0, 2 * np.pi))
    body = Body(item, rotation, draw.between(*settings.scale))
    if not body.is_scene:
        return body
    low, high = settings.zoom
    zoom = low * (high / low) ** draw.between(0, 1)
    return replace(body, zoom=zoom, about=tuple(draw.between(0, 1) for _ in range(4)))


def draw_look(sources: Sources, seed: int, epoch: int, number: int) -> Look:
    """The look of sample `number` in an epoch."""
    settings, camera = sources.settings, sources.manifest.camera
    draw = Draw("ocnf.synthesis.look", seed, epoch, number)
    k = draw.count(*settings.views)
    sigma = draw.between(*settings.sigma)
    model = _pick_name(draw, settings.noise)
    how = _pick_name(draw, settings.directions)
    key = f"ocnf.synthesis {epoch} {number}"
    directions: F64 | None
    if camera.path is not None:
        directions, views = None, tuple(range(k))
    elif how is Directions.SPHERE:
        directions, views = np.stack([_any_direction(draw) for _ in range(k)]), tuple(range(k))
    else:
        n = camera.n_views
        views = tuple(view_subset(n, k).tolist()) if how is Directions.RIG else _some_of(draw, n, k)
        directions = rig_from_name(camera.rig)[np.asarray(views)]
    # Of a stream of its own, so that the looks at meshes are what they were before there were scenes.
    scene = Draw("ocnf.synthesis.scene_look", seed, epoch, number)
    look = Look(directions, views, model, seed, key, sigma=sigma, cameras=_pick_name(scene, settings.cameras),
                background=scene.chance(0.5), misaligned=scene.between(*settings.misaligned))
    if model is NoiseModel.KINECT:
        return replace(look, sigma=0.0, strength=draw.between(*settings.strength))
    return look


def _pick_item(draw: Draw, pool: Pool, split: str) -> Item:
    if pool.items:
        return pool.items[draw.count(0, len(pool.items) - 1)]
    category, index = draw.pick(*pool.categories), draw.count(0, _SHAPES)
    return Item(f"{category}-{split}-{index}", split, category, procedural_name(category, split, index),
                index=index)


def _pick_name(draw: Draw, weights: Mapping[T, float]) -> T:
    """A name by its weight; the order in which a manifest lists them does not matter."""
    return _pick(draw, sorted(weights.items(), key=lambda pair: str(pair[0])))


def _pick(draw: Draw, options: Sequence[tuple[T, float]]) -> T:
    """One of the options (value, weight)."""
    left = draw.between(0, sum(weight for _, weight in options))
    for value, weight in options:
        left -= weight
        if left < 0:
            return value
    return options[-1][0]  # the sum was rounded up


def _some_of(draw: Draw, n: int, k: int) -> tuple[int, ...]:
    """Some k of 0 .. n-1, ascending, every subset as likely (the first k steps of a shuffle)."""
    numbers = list(range(n))
    for i in range(k):
        j = draw.count(i, n - 1)
        numbers[i], numbers[j] = numbers[j], numbers[i]
    return tuple(sorted(numbers[:k]))


def _any_direction(draw: Draw) -> F64:
    """A unit vector (3,), evenly on the sphere: z is uniform (Archimedes)."""
    z, phi = draw.between(-1, 1), draw.between(0, 2 * np.pi)
    ring = np.sqrt(1 - z * z)
    return np.array([ring * np.cos(phi), ring * np.sin(phi), z])


def _turn(axis: str, angle: float) -> F64:
    """Rotation (3, 3) about x, y or z by an angle in radians."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    rotation = np.eye(3)
    rotation[j, j] = rotation[k, k] = np.cos(angle)
    rotation[k, j] = np.sin(angle)
    rotation[j, k] = -rotation[k, j]
    return rotation


def _any_rotation(draw: Draw) -> F64:
    """Rotation (3, 3), uniform: a random unit quaternion (Shoemake, Graphics Gems III, 1992)."""
    u, a, b = draw.between(0, 1), draw.between(0, 2 * np.pi), draw.between(0, 2 * np.pi)
    x, y = np.sqrt(1 - u) * np.sin(a), np.sqrt(1 - u) * np.cos(a)
    z, w = np.sqrt(u) * np.sin(b), np.sqrt(u) * np.cos(b)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])
