"""Poses that do not quite fit each other, as those of a tracker do not.

A fusion of such views is blurred, and where it is, its votes lie as far apart as those of noisy depth; but
they are all votes for the same surface, a little moved, and their mean is nearly right.
"""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import Views
from ocnf_data.views.chance import keyed_random


def misalign(views: Views, sigma: float, seed: int, key: str) -> Views:
    """The same depth, with an error of its own in every pose.

    The camera is moved along, and turned about, each of its axes by normal errors, such that a point on the
    optical axis at the view's median depth d is moved, along each axis of the image, by a standard deviation
    of `sigma`: `sigma / sqrt(2)` of it by the shift, and as much by the turn, whose angle has
    `sigma / (sqrt(2) d)` radians. Along the axis there is the shift alone. Errors of different views have
    nothing to do with each other. Those of view i are a pure function of (seed, key, i), times sigma.

    Args:
        views: V views.
        sigma: metres, >= 0; 0 gives the views as they are.
        seed: the manifest's seed.
        key: the item's key.

    Raises:
        OcnfError: sigma is negative or not finite.
    """
    if not (np.isfinite(sigma) and sigma >= 0):
        raise OcnfError("not a standard deviation", where="misalign", field="sigma", found=sigma,
                        expected="metres, >= 0")
    if sigma == 0:
        return views
    part = sigma / np.sqrt(2)
    R, T = views.R.copy(), views.T.copy()
    for i, depth in enumerate(views.depth):
        measured = depth[np.isfinite(depth) & (depth > 0)]
        if not measured.size:
            continue  # it tells nothing, or only that all is free
        error = _normal(seed, key, i)
        turn = rotation_of(part / float(np.median(measured)) * error[3:])
        R[i], T[i] = turn @ R[i], turn @ T[i] + part * error[:3]
    return Views(views.depth, views.K, R, T)


def rotation_of(vector: F64) -> F64:
    """The rotation (3, 3) about a vector (3,) by its length in radians (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def _normal(seed: int, key: str, view: int) -> F64:
    """(6,) standard normal numbers by Box and Muller, of raw doubles, which no version of numpy changes."""
    uniform = keyed_random("misaligned", int(seed), key, view).random((2, 3))
    radius, angle = np.sqrt(-2 * np.log1p(-uniform[0])), 2 * np.pi * uniform[1]
    return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])
