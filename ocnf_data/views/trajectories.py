"""Hand-held paths: cameras that move around a thing, or through a room, as somebody with a sensor would.

A path is a smooth function of time, sampled at any number of moments, and a pure function of (seed, key).
What moves in it is a sum of slow waves with chance phases; a faint quick wave is the hand's tremor. Poses
are world to camera, as everywhere (`views.cameras`); the world's z points up.

Where geometry is in the way is asked of `clearance`, a function from points (N, 3) to the distance of what
is nearest to each in metres; `render.clearance` makes one from a mesh by rendering. A path that comes too
near to something is widened (around) or drawn together about its clearest point (inside), until it does not.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.chance import keyed_random

Clearance = Callable[[F64], F64]

_NAME = re.compile(r"(around|inside)(0|[1-9][0-9]{0,8})")
_MAX_VIEWS, _MAX_IN_A_RIG = 100_000, 2_000
_TRIES = 24
_WIDER, _TIGHTER = 1.12, 0.8  # a try
_CHECKED = 4  # points between two views that are checked too, at least _CHECKED_LEAST in all
_CHECKED_LEAST = 120
_ROLL = np.radians(4.0)
_TREMOR = np.radians(0.4)


def path_from_name(name: str) -> tuple[str, int] | None:
    """(kind, number of views) of `around<n>` or `inside<n>`; None for any other name.

    Raises:
        OcnfError: a number of views that is impossible.
    """
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    n = int(match[2])
    if not 1 <= n <= _MAX_IN_A_RIG:
        raise OcnfError("number of views out of range", field="rig", found=n,
                        expected=f"1 to {_MAX_IN_A_RIG}")
    return match[1], n


def path_around(n: int, seed: int, key: str, centre: Sequence[float], radius: float,
                clearance: Clearance | None = None, margin: float = 0.1) -> tuple[F64, F64]:
    """Cameras on an irregular walk around a point, looking at about it from above.

    They go round 0.6 to 1.4 times, at 0.8 to 1.2 times the radius and 10 to 65 degrees above the horizon.

    Args:
        n: number of cameras.
        seed: seed of the manifest.
        key: key of the item.
        centre: (x, y, z) of the point, metres.
        radius: mean distance of the cameras from the centre, metres.
        clearance: gives the distance to the nearest surface in metres (see the module); None: nothing is in
            the way.
        margin: metres that have to be free around the whole path.

    Returns:
        R (n, 3, 3), T (n, 3) metres, world to camera.

    Raises:
        OcnfError: a number of views or lengths that are impossible, or no path that is free (`crowded`).
    """
    _check(n, radius, margin)
    wave = _Waves(seed, key, "around")
    start, sweep = 2 * np.pi * wave.number(), 2 * np.pi * (0.6 + 0.8 * wave.number())
    height, far, aim = wave.curve(1.5), wave.curve(2.0), [wave.curve(1.5) for _ in range(3)]
    sway = [wave.curve(2.0), wave.curve(9.0), wave.curve(9.0), wave.curve(9.0)]

    def place(t: F64, wider: float) -> F64:
        azimuth, elevation = start + sweep * t, np.radians(37.5 + 27.5 * height(t))
        out = radius * wider * (1 + 0.2 * far(t))
        around = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                           np.sin(elevation)], axis=1)
        return np.asarray(np.array(centre) + out[:, None] * around)

    wider = 1.0
    for _ in range(_TRIES):
        if _free(partial(place, wider=wider), n, clearance, margin):
            t = _moments(n)
            target = np.array(centre) + 0.15 * radius * np.stack([curve(t) for curve in aim], axis=1)
            return _look(place(t, wider), target, sway, t)
        wider *= _WIDER
    raise _crowded(key, "around", margin)


def path_inside(n: int, seed: int, key: str, low: Sequence[float], high: Sequence[float],
                clearance: Clearance | None = None, margin: float = 0.25,
                watched: Sequence[float] | None = None) -> tuple[F64, F64]:
    """Cameras on a walk through a box, turning once or twice around, looking a little up and down.

    Arguments but these as for `path_around`.

    Args:
        n: number of cameras.
        seed: seed of the manifest.
        key: key of the item.
        low: corner (x, y, z) of the box that the cameras stay in, metres.
        high: the other corner.
        clearance: gives the distance to the nearest surface in metres (see the module); None: nothing is in
            the way.
        margin: metres that have to be free around the whole path.
        watched: a point (x, y, z), metres, that the cameras look at on the same walk, instead of turning
            around.

    Returns:
        R (n, 3, 3), T (n, 3) metres, world to camera.

    Raises:
        OcnfError: a number of views, a box or a margin that is impossible, or no path that is free
            (`crowded`).
    """
    corner, size = np.array(low, dtype=np.float64), np.subtract(high, low)
    _check(n, float(size.min()), margin)
    wave = _Waves(seed, key, "inside")
    along = [wave.curve(1.5) for _ in range(3)]
    yaw, turns = 2 * np.pi * wave.number(), (1 if wave.number() < 0.5 else -1) * (1 + wave.number())
    veer, nod = wave.curve(3.0), wave.curve(3.0)
    sway = [wave.curve(2.0), wave.curve(9.0), wave.curve(9.0), wave.curve(9.0)]

    def walk(t: F64) -> F64:
        return np.asarray(corner + size * (0.5 + 0.5 * np.stack([curve(t) for curve in along], axis=1)))

    middle = _clearest(walk, corner, size, wave, clearance)

    def place(t: F64, tighter: float) -> F64:
        return np.asarray(middle + tighter * (walk(t) - middle))

    tighter = 1.0
    for _ in range(_TRIES):
        if _free(partial(place, tighter=tighter), n, clearance, margin):
            t = _moments(n)
            position = place(t, tighter)
            if watched is not None:
                return _look(position, np.broadcast_to(watched, position.shape), sway, t)
            turned, pitch = yaw + 2 * np.pi * turns * t + 0.6 * veer(t), np.radians(-15 + 25 * nod(t))
            ahead = np.stack([np.cos(pitch) * np.cos(turned), np.cos(pitch) * np.sin(turned), np.sin(pitch)],
                             axis=1)
            return _look(position, position + ahead, sway, t)
        tighter *= _TIGHTER
    raise _crowded(key, "inside", margin)


def look_at(position: F64, target: F64) -> tuple[F64, F64]:
    """Upright cameras at `position` (n, 3) that look at `target` (n, 3), metres, not straight up or down.

    Returns:
        R (n, 3, 3), T (n, 3) metres, world to camera.
    """
    R = _level(position, target)
    return R, -np.einsum("vij,vj->vi", R, position)


class _Waves:
    """Chance that is a pure function of (seed, key, kind)."""

    def __init__(self, seed: int, key: str, kind: str) -> None:
        self._random = keyed_random("path", kind, int(seed), key).random

    def number(self) -> float:
        """A random number in [0, 1)."""
        return float(self._random())

    def curve(self, cycles: float) -> Callable[[F64], F64]:
        """A smooth function of t in [0, 1], values in [-1, 1]: three waves of up to `cycles` in all of t."""
        turns = cycles * np.array([self.number() for _ in range(3)])
        phases = 2 * np.pi * np.array([self.number() for _ in range(3)])
        shares = np.array([0.6, 0.25, 0.15])

        def at(t: F64) -> F64:
            waves = np.sin(2 * np.pi * turns * np.asarray(t)[:, None] + phases)
            return np.asarray(np.einsum("ij,j->i", waves, shares))

        return at


def _moments(n: int) -> F64:
    return np.linspace(0, 1, n) if n > 1 else np.array([0.5])


def _free(place: Callable[[F64], F64], n: int, clearance: Clearance | None, margin: float) -> bool:
    if clearance is None:
        return True
    between = _moments(max(_CHECKED * (n - 1) + 1, _CHECKED_LEAST) if n > 1 else 1)
    points = np.concatenate([place(_moments(n)), place(between)])
    return bool((clearance(points) >= margin).all())


def _clearest(walk: Callable[[F64], F64], corner: F64, size: F64, wave: _Waves,
              clearance: Clearance | None) -> F64:
    """The point of the path, or of some others in the box, that has most room."""
    if clearance is None:
        return np.asarray(corner + size / 2)
    others = corner + size * np.array([[wave.number() for _ in range(3)] for _ in range(64)])
    points = np.concatenate([others, walk(np.linspace(0, 1, 64))])
    return np.asarray(points[int(np.argmax(clearance(points)))])


def _look(position: F64, target: F64, sway: Sequence[Callable[[F64], F64]], t: F64) -> tuple[F64, F64]:
    """World to camera for cameras at `position` (n, 3) that look to `target`, rolled and shaken a little."""
    level = _level(position, target)
    roll, tremor = _ROLL * sway[0](t), [_TREMOR * wave(t) for wave in sway[1:]]
    R = _turn(2, roll + tremor[2]) @ _turn(1, tremor[1]) @ _turn(0, tremor[0]) @ level
    return R, -np.einsum("vij,vj->vi", R, position)


def _level(position: F64, target: F64) -> F64:
    """Rotations (n, 3, 3), world to camera: z to the target, x horizontal."""
    z = target - position
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _turn(axis: int, angle: F64) -> F64:
    """Rotations (n, 3, 3) about a camera axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R = np.tile(np.eye(3), (len(angle), 1, 1))
    R[:, i, i] = R[:, j, j] = np.cos(angle)
    R[:, j, i] = np.sin(angle)
    R[:, i, j] = -R[:, j, i]
    return R


def _check(n: int, length: float, margin: float) -> None:
    if not 1 <= n <= _MAX_VIEWS:
        raise OcnfError("number of views out of range", field="views", found=n, expected=f"1 to {_MAX_VIEWS}")
    for name, value in (("length", length), ("margin", margin)):
        if not (np.isfinite(value) and value > 0):
            raise OcnfError("not a length", where="a path", field=name, found=value, expected="metres > 0")


def _crowded(key: str, kind: str, margin: float) -> OcnfError:
    return OcnfError(f"no path {kind} is free of geometry", code="crowded", where=key,
                     expected=f"{margin:g} m around the whole path")
