"""The noise of a structured-light depth camera (Kinect v1), beside Park's of `noise`.

What such a camera does to a depth map, in the order in which it is applied here:

1. Edges are ragged: beside a silhouette a pixel shows what a pixel some way off shows. Nguyen et al. 2012
   (Modeling Kinect sensor noise for improved 3D reconstruction and tracking, eq. 1): standard deviation
   `0.8 + 0.035 theta / (pi/2 - theta)` pixels. Handa et al. 2014 (A benchmark for RGB-D visual odometry, 3D
   reconstruction and SLAM, sec. III-C, after Barron and Malik 2013) shift pixels by half a pixel instead.
2. Flying pixels: beside a silhouette some depths lie between the two surfaces.
3. Axial noise. Nguyen et al. 2012, eqs. 2-3, metres: `0.0012 + 0.0019 (z - 0.4)^2` up to 60 degrees between
   the ray and the surface's normal, and `+ 0.0001 / sqrt(z) theta^2 / (pi/2 - theta)^2` beyond.
4. Quantisation: what is measured is disparity, in whole steps. Khoshelham and Elberink 2012 (Accuracy and
   resolution of Kinect depth data for indoor mapping applications, eqs. 4-5 and sec. 4.3): a step is
   `2.85e-5 z^2` cm, z in cm, that is `z^2 / 351` in metres; Handa et al. 2014 round `35130 / z` in cm,
   which is the same. Nguyen's figure was measured behind the quantisation, whose own variance, step^2 / 12,
   is therefore taken off that of 3.
5. Nothing is measured outside of 0.5 to 5 m (Khoshelham and Elberink 2012, sec. 5), at grazing angles, and
   where the projector, 7.5 cm beside the camera, is hidden by something nearer (the shadows).

The noise of neighbouring pixels is not independent, because a disparity belongs to a window of 9 x 9 pixels
of the pattern, and in the real sequences of `docs/sensor.md` it is not either. So all fields of noise are
white noise averaged over such a window and scaled back: this package's addition to the three papers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ocnf_data.arrays import F32, F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.chance import keyed_random

_FOCAL = 585.0  # pixels, of the camera that the papers' pixels belong to
_STEPS = 351.3  # metres: 1 / (m / (f b)) of Khoshelham and Elberink; 8 steps a pixel, 585 pixels, 7.5 cm
_BASELINE = 0.075  # metres; the projector is on the side of positive x
_NEAREST, _FARTHEST = 0.5, 5.0  # metres
_WINDOW = 9.0  # pixels of a Kinect
_STEEP, _STEEPEST = np.radians(60.0), np.radians(85.0)
_GRAZING = np.radians(30.0)  # the share that is dropped grows from 0 to 1 over the last so much to 90 degrees
_IN_SHADOW = 0.4  # share of the pixels in the projector's shadow that have no depth
_FLYING = 0.05  # share of the pixels beside a silhouette that fly
_JUMP = 0.05  # of the depth: a silhouette
_FIELDS = 4


class SensorDraws(NamedTuple):
    """What chance gives to one view.

    Attributes:
        normal: (4, H, W) float32 white standard normal: axial, sideways, upwards, dropouts.
        uniform: (2, H, W) float32 in [0, 1): which pixels fly, and how far.
    """

    normal: F32
    uniform: F32


def sensor_draws(seed: int, key: str, view: int, size: tuple[int, int]) -> SensorDraws:
    """The draws of one view: Philox4x64 keyed by 128 bits of the SHA-256 of the three and the sensor's name.

    Like `view_noise` a pure function of its arguments, and independent of what that gives for the same view.

    Args:
        seed: the manifest's seed.
        key: the item's key.
        view: the view's index in the rig, not in the subset.
        size: (H, W) in pixels.
    """
    random = keyed_random("kinect", int(seed), key, int(view))
    return SensorDraws(random.standard_normal((_FIELDS, *size), dtype=np.float32),
                       random.random((2, *size), dtype=np.float32))


def add_sensor_noise(depth: F32, K: F64, draws: SensorDraws, strength: float = 1.0,
                     metres: float = 1.0) -> F32:
    """What a Kinect would have measured.

    Free rays stay free and pixels without a measurement stay so, but for the edges, which move both ways;
    what is not measured becomes 0. Pixels are counted at a Kinect's focal length, 585: a camera of half of
    it has half the raggedness and correlation in its own pixels.

    Args:
        depth: (H, W) float32 metres of one view.
        K: (3, 3) intrinsics in pixels.
        draws: the random numbers of this view, of the same size (H, W).
        strength: 0 is no noise at all, 1 a Kinect; standard deviations, steps and shares are multiplied.
        metres: real metres that one metre of `depth` stands for. Noise grows faster than distance, so it
            matters whether the 3 m cube holds a room or a cup.

    Returns:
        (H, W) float32 metres, a new array.

    Raises:
        OcnfError: a strength below 0, `metres` that are not positive, draws of another size.
    """
    for field, value, fits in (("strength", strength, strength >= 0), ("metres", metres, metres > 0)):
        if not (np.isfinite(value) and fits):
            raise OcnfError(f"{field} is not a factor", where="add_sensor_noise", field=field, found=value)
    if depth.ndim != 2 or draws.normal.shape != (_FIELDS, *depth.shape):
        raise OcnfError("the draws do not fit the depth", where="add_sensor_noise", field="draws",
                        found=draws.normal.shape, expected=(_FIELDS, *depth.shape))
    clean = np.ascontiguousarray(depth, dtype=np.float32)
    if strength == 0:
        return clean.copy()
    reach = round(_WINDOW * float(K[0, 0]) / _FOCAL) // 2
    fields = np.stack([_averaged(field, reach) for field in draws.normal])
    return _sense(clean, _pinhole(K), fields, draws.uniform, strength, metres)


def pixel_angles(depth: F32, K: F64) -> F32:
    """Angle (H, W) in radians, at most 85 degrees, between each pixel's ray and the normal of its surface.

    Args:
        depth: (H, W) float32 metres, of one view; free and unmeasured pixels have the angle 0.
        K: (3, 3) intrinsics in pixels.
    """
    return _angles(np.ascontiguousarray(depth, dtype=np.float32), _pinhole(K))


def _pinhole(K: F64) -> F64:
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dtype=np.float64)


@njit(cache=True, nogil=True)
def _angles(clean: F32, pinhole: F64) -> F32:
    out = np.empty_like(clean)
    for v in range(len(clean)):
        for u in range(clean.shape[1]):
            out[v, u] = _angle(clean, pinhole, v, u)
    return out


@njit(cache=True, nogil=True)
def _averaged(field: F32, reach: int) -> F32:
    """White noise (H, W) averaged over 2 reach + 1 pixels square, of unit variance again, borders too."""
    height, width = field.shape
    rows, out = np.empty_like(field), np.empty_like(field)
    total = np.zeros(width)  # of the window's rows, in each column; float64, so that sums can run
    for v in range(-reach, height):
        if v + reach < height:
            total += field[v + reach]
        if v - reach - 1 >= 0:
            total -= field[v - reach - 1]
        if v >= 0:
            rows[v] = total / math.sqrt(min(v + reach + 1, height) - max(v - reach, 0))
    for v in range(height):
        running = 0.0
        for u in range(-reach, width):
            if u + reach < width:
                running += rows[v, u + reach]
            if u - reach - 1 >= 0:
                running -= rows[v, u - reach - 1]
            if u >= 0:
                out[v, u] = running / math.sqrt(min(u + reach + 1, width) - max(u - reach, 0))
    return out


@njit(cache=True, nogil=True)
def _sense(clean: F32, pinhole: F64, fields: F32, uniform: F32, strength: float, metres: float) -> F32:
    height, width = clean.shape
    out = np.zeros_like(clean)
    shadow = np.empty(width, np.bool_)
    for v in range(height):
        _shadows(clean[v], pinhole[0], metres, shadow)
        for u in range(width):
            row, column = _source(clean, pinhole, fields, v, u, strength)
            z = float(clean[row, column]) * metres
            if z == 0 or np.isinf(z):
                out[v, u] = clean[row, column]
                continue
            angle = _angle(clean, pinhole, row, column)
            if _dropped(fields[3, v, u], z, angle, shadow[u], strength):
                continue
            if uniform[0, v, u] < _FLYING * strength:
                z += uniform[1, v, u] * (_across(clean, row, column) * metres - z)
            z += fields[0, v, u] * strength * _axial(z, angle)
            steps = _STEPS / strength
            disparity = max(np.floor(steps / max(z, 1e-3) + 0.5), 1.0)
            out[v, u] = np.float32(steps / disparity / metres)
    return out


@njit(cache=True, nogil=True)
def _axial(z: float, angle: float) -> float:
    """Standard deviation, metres, before quantisation: Nguyen et al. 2012, eqs. 2-3, less step^2 / 12."""
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
    if angle > _STEEP:
        sigma += 0.0001 / math.sqrt(z) * angle * angle / (math.pi / 2 - angle) ** 2
    step = z * z / _STEPS
    return math.sqrt(max(sigma * sigma - step * step / 12, 0.0))


@njit(cache=True, nogil=True)
def _source(clean: F32, pinhole: F64, fields: F32, v: int, u: int, strength: float) -> tuple[int, int]:
    """(row, column) of the pixel that this one shows: another one only across a silhouette."""
    height, width = clean.shape
    angle = _angle(clean, pinhole, v, u)
    sigma = strength * (0.8 + 0.035 * angle / (math.pi / 2 - angle)) * pinhole[0] / _FOCAL
    column = u + int(np.floor(fields[1, v, u] * sigma + 0.5))
    row = v + int(np.floor(fields[2, v, u] * sigma + 0.5))
    if not (0 <= row < height and 0 <= column < width):
        return v, u
    return (row, column) if _jumps(clean[v, u], clean[row, column]) else (v, u)


@njit(cache=True, nogil=True)
def _jumps(a: float, b: float) -> bool:
    """Whether a silhouette lies between two depths; a pixel without a measurement has none."""
    if a == 0 or b == 0:
        return False
    if np.isinf(a) or np.isinf(b):
        return np.isinf(a) != np.isinf(b)
    return abs(a - b) > _JUMP * min(a, b)


@njit(cache=True, nogil=True)
def _across(clean: F32, v: int, u: int) -> float:
    """Depth of a neighbour on the other side of a silhouette; the pixel's own where there is none."""
    height, width = clean.shape
    own = clean[v, u]
    for row, column in ((v, u - 1), (v, u + 1), (v - 1, u), (v + 1, u)):
        if 0 <= row < height and 0 <= column < width:
            other = clean[row, column]
            if np.isfinite(other) and _jumps(own, other):
                return float(other)
    return float(own)


@njit(cache=True, nogil=True)
def _angle(clean: F32, pinhole: F64, v: int, u: int) -> float:
    """Angle in radians between ray and normal, at most `_STEEPEST`; 0 where it is not known.

    On a plane n X = 1 the inverse depth is w = n (x, y, 1), affine in the pixel, so that n follows from
    the differences of w. Of the two on either side the smaller one is taken: the other may cross an edge.
    """
    z = clean[v, u]
    if z == 0 or np.isinf(z):
        return 0.0
    w = 1.0 / z
    nx = pinhole[0] * _slope(clean, v, u, 0, 1, w)
    ny = pinhole[1] * _slope(clean, v, u, 1, 0, w)
    x, y = (u - pinhole[2]) / pinhole[0], (v - pinhole[3]) / pinhole[1]
    nz = w - nx * x - ny * y
    cosine = w / math.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + 1.0))
    return min(math.acos(min(cosine, 1.0)), _STEEPEST)


@njit(cache=True, nogil=True)
def _slope(clean: F32, v: int, u: int, down: int, right: int, w: float) -> float:
    """Difference of the inverse depth to the next pixel along a direction, or from the one before."""
    best = np.inf
    for sign in (-1, 1):
        row, column = v + sign * down, u + sign * right
        if 0 <= row < clean.shape[0] and 0 <= column < clean.shape[1]:
            other = clean[row, column]
            if other > 0 and np.isfinite(other):
                step = sign * (1.0 / other - w)
                if abs(step) < abs(best):
                    best = step
    return best if np.isfinite(best) else 0.0


@njit(cache=True, nogil=True)
def _dropped(chance: float, z: float, angle: float, shadow: bool, strength: float) -> bool:
    """Whether nothing is measured; `chance` is standard normal, so that its distribution's value is even."""
    share = 1.0 if z < _NEAREST or z > _FARTHEST else 0.0
    share = max(share, _IN_SHADOW if shadow else 0.0)
    grazing = (angle - (math.pi / 2 - _GRAZING)) / _GRAZING
    if grazing > 0:
        share = max(share, grazing * grazing)
    return 0.5 * math.erfc(-chance / math.sqrt(2.0)) < share * strength


@njit(cache=True, nogil=True)
def _shadows(row: F32, focal: float, metres: float, shadow: np.ndarray) -> None:
    """Mark the pixels of a row that the projector does not see: something to their right is in its way.

    The projector sees a pixel of depth z in its column u - f b / z (its own image, of the same focal length),
    so a pixel is hidden where one to the right of it has a column not right of its own.
    """
    leftmost = np.inf
    for u in range(len(row) - 1, -1, -1):
        z = row[u] * metres
        column = u - focal * _BASELINE / z if z > 0 else np.inf
        shadow[u] = z > 0 and leftmost < column - 1.0
        leftmost = min(leftmost, column)
