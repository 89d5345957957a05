"""Camera rigs: where the virtual cameras stand around a normalised mesh.

A rig is an array of unit directions (N, 3); `look_from` turns it into poses. The camera of direction t has
`R = Rz(180 deg) A`, A being the smallest rotation that takes (0, 0, 1) to t, and `T = (0, 0, distance)`:
world to camera, `X_c = R X + T`, as in the published code. So every camera has the origin on its optical
axis at depth `distance`. Mind that R leads from the world *to* the camera although A leads from the axis to
t: the camera's centre `-R^T T` is `distance * (t_x, t_y, -t_z)`, the mirror image of `distance * t`.
"""

from __future__ import annotations

import re

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError

_MAX_SUBDIVISIONS = 5
_MAX_DIRECTIONS = 20 * 4**_MAX_SUBDIVISIONS
_RING_LATITUDE = np.arctan(0.5)  # 26.565 degrees

# Vertex 0 is the south pole, 1-5 the lower ring, 6-10 the upper, 11 the north pole. The order of the faces
# is the published one; view numbers, and with them view subsets and noise, depend on it.
_ICOSAHEDRON_FACES = np.array([
    (0, 2, 1), (0, 3, 2), (0, 4, 3), (0, 5, 4), (0, 1, 5),
    (1, 2, 7), (2, 3, 8), (3, 4, 9), (4, 5, 10), (5, 1, 6),
    (1, 7, 6), (2, 8, 7), (3, 9, 8), (4, 10, 9), (5, 6, 10),
    (6, 7, 11), (7, 8, 11), (8, 9, 11), (9, 10, 11), (10, 6, 11),
])  # fmt: skip


def rig_from_name(name: str) -> F64:
    """The directions (N, 3) of `published80`, `icosphere<n>` (20 * 4^n of them) or `fibonacci<n>` (n).

    >>> rig_from_name("icosphere1").shape, rig_from_name("fibonacci100").shape
    ((80, 3), (100, 3))

    Raises:
        OcnfError: no rig has that name, or its number is out of range.
    """
    if name == "published80":
        return published80()
    match = re.fullmatch(r"(icosphere|fibonacci)(0|[1-9][0-9]{0,8})", name)
    if match is None:
        raise OcnfError("unknown camera rig", field="rig", found=name,
                        expected="published80, icosphere<subdivisions> or fibonacci<views>")
    return {"icosphere": icosphere, "fibonacci": fibonacci}[match[1]](int(match[2]))


def published80() -> F64:
    """The 80 directions (80, 3) of the paper's data set, as its published code has them.

    The authors meant to subdivide each face of an icosahedron at its edge midpoints; because of a slip their
    midpoint of edge (a, b) is a / sqrt(2), so the spacing is uneven. The rig they meant is `icosphere(1)`.
    """
    v1, v2, v3 = np.moveaxis(_icosahedron()[_ICOSAHEDRON_FACES], 1, 0)  # (20, 3) each
    v4, v5, v6 = v1 / np.sqrt(2), v2 / np.sqrt(2), v3 / np.sqrt(2)
    means = np.stack([v1 + v4 + v6, v4 + v2 + v5, v6 + v5 + v3, v6 + v4 + v5], axis=1)  # (20, 4, 3)
    return _normalised(means.reshape(-1, 3))


def icosphere(n_subdivisions: int) -> F64:
    """The face centres (20 * 4^n, 3) of an icosahedron whose faces were split in four n times.

    Edge midpoints are pushed out to the unit sphere after each split. The four children of face i are faces
    4i .. 4i + 3: the one at each corner, then the one in the middle.

    Raises:
        OcnfError: `n_subdivisions` is not 0 to 5.
    """
    if not 0 <= n_subdivisions <= _MAX_SUBDIVISIONS:
        raise OcnfError("number of subdivisions out of range", field="rig", found=n_subdivisions,
                        expected=f"0 to {_MAX_SUBDIVISIONS}")
    corners = _icosahedron()[_ICOSAHEDRON_FACES]  # (20, 3 corners, 3)
    for _ in range(n_subdivisions):
        a, b, c = np.moveaxis(corners, 1, 0)
        ab, bc, ca = _normalised(a + b), _normalised(b + c), _normalised(c + a)
        children = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ca, ab, bc)]
        corners = np.stack([np.stack(child, axis=1) for child in children], axis=1).reshape(-1, 3, 3)
    return _normalised(corners.sum(axis=1))


def fibonacci(n: int) -> F64:
    """The n nearly evenly spread directions (n, 3) of the Fibonacci spiral, from near +z down to near -z.

    Raises:
        OcnfError: `n` is not 1 to 20480.
    """
    if not 1 <= n <= _MAX_DIRECTIONS:
        raise OcnfError("number of views out of range", field="rig", found=n,
                        expected=f"1 to {_MAX_DIRECTIONS}")
    i = np.arange(n)
    z = 1.0 - (2.0 * i + 1.0) / n
    phi = i * (np.pi * (3.0 - np.sqrt(5.0)))  # the golden angle
    ring = np.sqrt(1.0 - z * z)
    return _normalised(np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=1))


def look_from(directions: F64, distance: float) -> tuple[F64, F64]:
    """Poses (R (N, 3, 3), T (N, 3) metres), world to camera, of the cameras of `directions` (N, 3).

    All of them look at the origin from `distance` metres; see the module's docstring for the convention.

    Raises:
        OcnfError: `directions` are not (N, 3), finite and none of them zero, or `distance` is not finite and
            above 0.
    """
    t = np.asarray(directions, dtype=np.float64)
    if t.ndim != 2 or t.shape[1] != 3 or not np.isfinite(t).all() or not np.linalg.norm(t, axis=1).all():
        raise OcnfError("directions are not non-zero vectors", field="directions", found=t.shape,
                        expected="(N, 3), finite, none of them zero")
    if not (np.isfinite(distance) and distance > 0):
        raise OcnfError("distance is not positive", field="distance", found=distance, expected="metres > 0")
    half_turn = np.diag([-1.0, -1.0, 1.0])  # Rz(180 deg)
    R = half_turn @ _smallest_rotation(_normalised(t))
    T = np.broadcast_to([0.0, 0.0, float(distance)], t.shape).copy()
    return R, T


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> F64:
    """The pinhole matrix K (3, 3), pixels; pixel centres lie on integer coordinates."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def view_subset(n_rig: int, k: int) -> I64:
    """Indices (k,) of k views spread over a rig of n_rig: `linspace(0, n_rig - 1, k)` truncated, 0 for k = 1.

    >>> view_subset(80, 4)
    array([ 0, 26, 52, 79])

    Raises:
        OcnfError: `k` is not 1 to `n_rig`.
    """
    if not 1 <= k <= n_rig:
        raise OcnfError("cannot choose that many views", field="views", found=k, expected=f"1 to {n_rig}")
    # In integers: a linspace of floats can come out a hair below a whole number and lose 1 by truncation.
    return np.arange(k, dtype=np.int64) * (n_rig - 1) // max(k - 1, 1)


def _icosahedron() -> F64:
    """The 12 unit vertices (12, 3): poles on the z axis, rings at latitude -+26.565 degrees."""
    k = np.arange(5)
    rings = [
        np.stack([np.cos(lat) * np.cos(phi), np.cos(lat) * np.sin(phi), np.full(5, np.sin(lat))], axis=1)
        for lat, phi in ((-_RING_LATITUDE, np.deg2rad(36 + 72 * k)), (_RING_LATITUDE, np.deg2rad(72 * k)))
    ]
    return np.concatenate([[[0.0, 0.0, -1.0]], *rings, [[0.0, 0.0, 1.0]]])


def _smallest_rotation(t: F64) -> F64:
    """A (N, 3, 3) with `A (0, 0, 1) = t` for unit t (N, 3), turning about an axis in the xy plane."""
    x, y, z = t.T
    across = x * x + y * y
    opposite = across == 0  # t = -+(0, 0, 1): for -z any half turn about an axis in the xy plane would do
    # 1 / (1 + z), which loses all digits near z = -1, is (1 - z) / (x^2 + y^2) there.
    below = z < 0
    k = np.where(below, (1.0 - z) / np.where(opposite, 1.0, across), 1.0 / np.where(below, 1.0, 1.0 + z))
    A = np.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])
    A = np.moveaxis(A, -1, 0)
    A[opposite & below] = np.diag([1.0, -1.0, -1.0])
    return A


def _normalised(vectors: F64) -> F64:
    unit: F64 = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit
