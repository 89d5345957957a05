"""Do the frames of a scan agree with each other under the convention that they were read by?

A pose that is taken the wrong way round, a trajectory in millimetres, a wrong depth scale or wrong
intrinsics give no error by themselves: they give a surface that is fog. So depth of frame i is put into
frame j, for pairs that are near in order: where both measured something, either they agree (within 3 %
of the distance, or 3 cm), or one of them sees past the other. Surfaces hidden from one of them disagree
rightly; but in a scan that is read rightly most depths agree, and under a wrong reading fewer do: few where
the frames are far apart, nearly as many where they are neighbours of a film. So other readings are tried: the
poses the other way round, the axes of the other convention, depth of other units; and that one of them agrees
clearly better says more than any share. What is round and turns about the origin agrees with the poses the
other way round too, even better where frames are few; but under the right poses no frame sees past what
another has measured. A camera that only turns agrees at every scale; wrong intrinsics are noticed only by
what is seen past.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans.listing import Axes
from ocnf_data.views.scans.poses import FLIP

_PAIRS = 60
_STEPS = (1, 2, 4)  # how far apart in order the two frames of a pair are
_POINTS = 3000  # a frame
_TOLERANCE, _LEAST = 0.03, 0.03  # of the distance; metres
_ENOUGH = 200  # depths to compare; fewer say nothing
_FEW = 0.3  # less than this share agreeing is worth a warning
_BETTER = 0.1  # another reading has to agree by this much more to be named
_PAST = 0.05  # poses are in doubt if more than this share is seen past; under wrong ones it is 10 to 40 %
_THROUGH = 0.08  # so much seen past is worth a warning by itself; right readings of real scans have up to 5 %
_MILLIMETRES = 1000  # of the depth: as if the translations were millimetres
_FACTORS = (0.001, 0.1, 0.2, 0.25, 0.5, 2, 4, 5, 10, _MILLIMETRES)  # as mixed-up units have them
_SCALED, _CLEARED = 0.05, 0.02  # a factor is named if so much more agrees, and so much less is seen past
_SURE = 0.6  # share that has to agree under another reading to be sure of it
_CLOSE = 10 * _LEAST  # metres; nearer than that almost anything is within the least tolerance
_FAR = 20  # times the typical depth: cameras this far apart are not of one scan
_SAMPLE = 100_000  # depths that the typical one is of


@dataclass(frozen=True)
class Agreement:
    """How far frames agree.

    Attributes:
        compared: depths that one frame of a pair measured and that fell onto a measurement of the other.
        share: share of the compared depths that agree, 0 to 1; NaN where nothing was compared.
        inverse: the share if the poses were meant the other way round.
        millimetres: the share if the translations were millimetres.
        past: share of the compared depths that the other frame sees past: it has measured what lies behind.
        flipped: the share if the axes of the cameras were those of the other convention (y and z reversed).
        factor: by what the depth would have to be multiplied for clearly more of it to agree; 1 where no
            factor that was tried does so.
        scaled: the share with the depth multiplied by it.
    """

    compared: int
    share: float
    inverse: float
    millimetres: float
    past: float
    flipped: float = float("nan")
    factor: float = 1.0
    scaled: float = float("nan")

    def __str__(self) -> str:
        """Both figures, as a clause."""
        if np.isnan(self.share) and np.isnan(self.inverse):
            return "there is nothing that two frames have both measured"
        as_read = "nothing can be compared" if np.isnan(self.share) else \
            f"{_percent(self.share)} of the depths agree"
        return f"{as_read} as read, {_percent(self.inverse)} with the poses the other way round"


def agreement(views: Views, axes: Axes = Axes.OPENCV) -> Agreement:
    """Compare pairs of frames that are near in order.

    Args:
        views: the views as they were read.
        axes: axes of the cameras in the file's pose matrices; needed to try the poses the other way round.
    """
    to_world = np.tile(np.eye(4), (len(views), 1, 1))
    to_world[:, :3, :3] = views.R.swapaxes(1, 2)
    to_world[:, :3, 3] = views.centres
    compared, share, past = _share(views, to_world)
    flip = FLIP if axes is Axes.OPENGL else np.eye(4)
    _, inverse, _ = _share(views, np.linalg.inv(to_world @ flip) @ flip)
    _, flipped, _ = _share(views, to_world @ FLIP)
    factor, scaled, lead, millimetres = 1.0, share, share - past, float("nan")
    for tried in _FACTORS:  # depth and translations are lengths: to divide the one is to multiply the other
        small = to_world.copy()
        small[:, :3, 3] /= tried
        n, more, less = _share(views, small)
        if tried == _MILLIMETRES:
            millimetres = more
        clearly = more > max(share + _SCALED, _SURE) and less < past - _CLEARED
        if n >= _ENOUGH and clearly and more - less > lead:
            factor, scaled, lead = tried, more, more - less
    return Agreement(compared, share, inverse, millimetres, past, flipped, factor, scaled)


def judge(found: Agreement, views: Views, where: object) -> list[str]:
    """Warnings, a sentence each, about a scan that does not agree with itself.

    Raises:
        OcnfError: the translations are in millimetres.
    """
    spread, typical = float(np.ptp(views.centres, axis=0).max()), _typical(views)
    weak = not found.share >= _FEW  # NaN is weak
    if typical < _LEAST or (weak and typical < _CLOSE and spread > _FAR * typical):
        return [f"the depths look too small: half of them are below {typical:.2g} m, with cameras spread "
                f"over {spread:.2g} m; check the depth scale (1 for values in metres)"]
    if weak and found.millimetres > _SURE and spread > _FAR * typical:
        raise OcnfError(
            "the translations of the poses look like millimetres", where=where,
            found=f"cameras spread over {spread:.4g} with depths of {typical:.2g} m; read as metres "
                  f"{_percent(found.share)} of the depths of neighbouring frames agree, as millimetres "
                  f"{_percent(found.millimetres)}",
            expected="metres", fix="give the pose scale 0.001 if they are (--pose-scale 0.001)")
    if len(views) < 2:
        return []
    doubtful = found.compared < _ENOUGH or found.past > _PAST
    if doubtful and found.inverse >= _SURE and found.inverse > np.nan_to_num(found.share) + _BETTER:
        return [f"the poses may be meant the other way round: {found}"]
    if doubtful and found.flipped >= _SURE and found.flipped > np.nan_to_num(found.share) + _BETTER:
        return [f"the axes of the cameras may be those of the other convention (opencv, opengl): {found}, "
                f"{_percent(found.flipped)} with y and z reversed; say which with --axes, or axes="]
    if found.factor != 1:
        return ["the scale of the depth or of the poses may be wrong: "
                f"{_percent(found.share)} of the depths agree as read, {_percent(found.scaled)} "
                f"if depth were {found.factor:g} times as large, or translations {1 / found.factor:g} times; "
                "check the depth scale and the pose scale"]
    if found.compared < _ENOUGH:
        figures = f"{found.compared} depths could be compared; {found}" if found.compared else str(found)
        return [f"neighbouring frames hardly overlap ({figures}), so that nothing confirms the direction of "
                "the poses and the scale of the depth"]
    if weak:
        return [f"the frames hardly agree with each other: {found}; check depth scale, intrinsics and poses"]
    if found.past > _THROUGH:
        return [f"the frames see through each other's surfaces at {_percent(found.past)} of the depths "
                f"({found}); check depth scale, intrinsics and poses"]
    return []


def _typical(views: Views) -> float:
    """The median of some of the depths, spread over all views; 1 m where nothing was measured."""
    step = max(1, int(np.sqrt(views.depth.size / _SAMPLE)))
    depth = views.depth[:, ::step, ::step]
    depth = depth[np.isfinite(depth) & (depth > 0)]
    return float(np.median(depth)) if depth.size else 1.0


def _share(views: Views, to_world: F64) -> tuple[int, float, float]:
    """(depths compared, share of them that agree, that are seen past) over the pairs; NaN where none is."""
    counts = np.zeros(3, np.int64)
    to_camera = np.linalg.inv(to_world)
    for i, j in _pairs(len(views)):
        counts += _compare(views, i, j, to_camera[j] @ to_world[i])
    near, past, compared = counts.tolist()
    return (compared, near / compared, past / compared) if compared else (0, float("nan"), float("nan"))


def _pairs(n: int) -> list[tuple[int, int]]:
    pairs = [(i, i + step) for step in _STEPS for i in range(n - step)]
    return pairs[:: max(1, -(-len(pairs) // _PAIRS))]


def _compare(views: Views, i: int, j: int, between: F64) -> tuple[int, int, int]:
    """How many of frame i's depths, put into frame j by `between`, agree, are seen past, can be compared."""
    height, width = views.size
    step = max(1, int(np.sqrt(height * width / _POINTS)))
    v, u = (axis.ravel() for axis in np.mgrid[step // 2 : height : step, step // 2 : width : step])
    z = views.depth[i, v, u].astype(np.float64)
    hit = (z > 0) & np.isfinite(z)
    u, v, z = u[hit], v[hit], z[hit]
    K, L = views.K[i], views.K[j]
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z])
    x, y, z = between[:3, :3] @ points + between[:3, 3:]
    before = z > 1e-6
    x, y, z = x[before], y[before], z[before]
    column, row = np.floor(L[0, 0] * x / z + L[0, 2] + 0.5), np.floor(L[1, 1] * y / z + L[1, 2] + 0.5)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    measured = views.depth[j, row[inside].astype(np.int64), column[inside].astype(np.int64)]
    z = z[inside]
    known = (measured > 0) & np.isfinite(measured)
    behind, allowed = (measured - z)[known], np.maximum(_TOLERANCE * z[known], _LEAST)
    return int((np.abs(behind) <= allowed).sum()), int((behind > allowed).sum()), int(known.sum())


def _percent(share: float) -> str:
    return "none" if np.isnan(share) else f"{100 * share:.0f} %"
