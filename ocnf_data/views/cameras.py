"""Posed depth views, the one thing that passes from the sources to fusion.

Cameras follow OpenCV: x right, y down, z forward, `X_c = R X + T` from world to camera. Depth is `z_c` in
metres, not the length of the ray. Pixel centres lie on integer coordinates: pixel (u, v), column u and
row v, sees the ray through exactly (u, v).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import F32, F64, as_numbers
from ocnf_data.errors import OcnfError

# A rotation read from a text file with six digits is off by about 1e-6; one off by more is not a rotation.
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Views:
    """V posed depth maps of one scene.

    Attributes:
        depth: (V, H, W) float32, z in metres; `inf` is a ray that hits nothing and carves all along,
            `0` is a pixel without a measurement, which says nothing.
        K: (V, 3, 3) float64 intrinsics in pixels, without skew (a single (3, 3) is accepted and repeated).
        R: (V, 3, 3) float64, world to camera.
        T: (V, 3) float64 metres, world to camera.

    Raises:
        OcnfError: no numbers, shapes that do not fit, negative or NaN depth, a K that is not a pinhole's, an
            R that is not a rotation.
    """

    depth: F32
    K: F64
    R: F64
    T: F64

    def __post_init__(self) -> None:
        depth = np.ascontiguousarray(as_numbers(self.depth, "Views", "depth", np.float32))
        R = np.ascontiguousarray(as_numbers(self.R, "Views", "R", np.float64))
        T = np.ascontiguousarray(as_numbers(self.T, "Views", "T", np.float64))
        if depth.ndim != 3 or depth.size == 0:
            raise OcnfError("depth has the wrong shape", where="Views", field="depth",
                            found=depth.shape, expected="(V, H, W) with V, H, W >= 1")
        v = depth.shape[0]
        K = _pinhole(self.K, v)
        for name, array, shape in (("R", R, (v, 3, 3)), ("T", T, (v, 3))):
            if array.shape != shape:
                raise OcnfError(f"{name} does not fit the {v} depth maps", where="Views", field=name,
                                found=array.shape, expected=shape)
            if not np.isfinite(array).all():
                raise OcnfError(f"{name} is not finite", where="Views", field=name)
        check_rotation(R, where="Views")
        if not (depth >= 0).all():  # also catches NaN
            raise OcnfError("depth is negative or NaN", where="Views", field="depth",
                            expected="metres > 0, inf for a free ray, 0 for no measurement")
        object.__setattr__(self, "depth", depth)
        for name, array in (("K", K), ("R", R), ("T", T)):
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return int(self.depth.shape[0])

    @property
    def size(self) -> tuple[int, int]:
        """Image size as (H, W)."""
        return int(self.depth.shape[1]), int(self.depth.shape[2])

    @property
    def centres(self) -> F64:
        """Where the cameras stand, (V, 3) metres in world coordinates."""
        return np.asarray(-np.einsum("vji,vj->vi", self.R, self.T))

    def subset(self, indices: Sequence[int] | npt.NDArray[np.integer]) -> Views:
        """The views at `indices`, in that order, or those where a mask (V,) of bool is true.

        Raises:
            OcnfError: neither whole numbers nor such a mask, or there is no such view.
        """
        index = np.asarray(indices)
        if index.dtype == bool and index.shape == (len(self),):
            index = np.flatnonzero(index)
        whole = index.ndim == 1 and index.size and np.issubdtype(index.dtype, np.integer)
        if not whole or not -len(self) <= index.min() <= index.max() < len(self):
            raise OcnfError("no such views", where="Views", field="indices", found=indices,
                            expected=f"whole numbers from 0 to {len(self) - 1}, at least one, or a mask of "
                                     f"{len(self)}")
        index = index.astype(np.int64)
        return Views(self.depth[index], self.K[index], self.R[index], self.T[index])

    def with_depth(self, depth: F32) -> Views:
        """Views of these cameras with other depth maps (V, H, W)."""
        return Views(depth, self.K, self.R, self.T)

    def without_background(self) -> Views:
        """The same views, but rays that meet nothing measure 0, as those of a sensor do, not inf."""
        return self.with_depth(np.where(np.isfinite(self.depth), self.depth, np.float32(0)))


def check_rotation(R: F64, where: object) -> None:
    """Raise OcnfError unless every (3, 3) matrix in R (V, 3, 3) is a proper rotation."""
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    bad = np.flatnonzero((off > _ROTATION_TOLERANCE) | (np.linalg.det(R) < 0))
    if bad.size:
        i = int(bad[0])
        raise OcnfError("not a rotation", where=where, field=f"R[{i}]",
                        found=f"|R R^T - 1| = {off[i]:.2g}, det = {np.linalg.det(R[i]):.3g}",
                        expected="an orthonormal matrix with determinant +1")


def _pinhole(K: F64, n_views: int) -> F64:
    K = as_numbers(K, "Views", "K", np.float64)
    if K.shape == (3, 3):
        K = np.broadcast_to(K, (n_views, 3, 3))
    if K.shape != (n_views, 3, 3):
        raise OcnfError(f"K does not fit the {n_views} depth maps", where="Views", field="K",
                        found=K.shape, expected=f"(3, 3) or ({n_views}, 3, 3)")
    focal_ok = np.isfinite(K).all() and (K[:, 0, 0] > 0).all() and (K[:, 1, 1] > 0).all()
    rest = K.copy()
    rest[:, 0, 0] = rest[:, 1, 1] = rest[:, 0, 2] = rest[:, 1, 2] = 0
    if not focal_ok or not np.array_equal(rest, np.broadcast_to(np.diag([0.0, 0.0, 1.0]), K.shape)):
        raise OcnfError("not a pinhole's intrinsics", where="Views", field="K",
                        found=K[0].tolist(), expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
    return np.ascontiguousarray(K)


def resized(K: F64, before: tuple[int, int], after: tuple[int, int]) -> F64:
    """K (..., 3, 3) of images (H, W) scaled to another size; pixel centres stay on integers."""
    scale = np.array([after[1] / before[1], after[0] / before[0]])
    new = np.array(K, dtype=np.float64)
    new[..., :2, :2] *= scale[:, None]
    new[..., :2, 2] = (new[..., :2, 2] + 0.5) * scale - 0.5
    return new


def same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether an image (H, W) can be the other one scaled, to within less than a pixel of rounding."""
    small, large = sorted((one, other))
    return max((a - 1) / b for a, b in zip(small, large, strict=True)) < min(
        (a + 1) / b for a, b in zip(small, large, strict=True))
