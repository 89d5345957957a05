"""Pose matrices, in whatever convention, as world to camera with OpenCV's axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import check_rotation
from ocnf_data.views.scans.listing import Axes, Direction

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between OpenCV's camera axes and OpenGL's, either way."""


def to_camera(poses: F64, names: Sequence[object], direction: Direction, axes: Axes,
              scale: float = 1.0) -> tuple[F64, F64]:
    """(R (V, 3, 3), T (V, 3) metres), world to camera, with every rotation made exactly orthonormal.

    Args:
        poses: (V, 4, 4) rigid motions.
        names: what to call each one in an error.
        direction: what the matrices do with a point.
        axes: axes of the cameras, on the camera's side of the matrix.
        scale: length in metres of a unit of the translations.

    Raises:
        OcnfError: a matrix that is not finite, or not rigid, by its name.
    """
    for pose, name in zip(poses, names, strict=True):
        if not np.isfinite(pose).all():
            raise OcnfError("the pose is not finite", code="non_finite", where=name, found=pose.tolist())
        if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
            raise OcnfError("the last row of a pose is 0 0 0 1", where=name, found=pose[3].tolist())
        check_rotation(pose[None, :3, :3], where=name)
    left, _, right = np.linalg.svd(poses[:, :3, :3])
    turn, shift = left @ right, poses[:, :3, 3] * scale
    if direction is Direction.CAMERA_TO_WORLD:
        turn = turn.swapaxes(1, 2)
        shift = -np.einsum("vij,vj->vi", turn, shift)
    if axes is Axes.OPENGL:
        turn, shift = FLIP[:3, :3] @ turn, shift @ FLIP[:3, :3]
    return turn, shift


def quaternion_pose(translation: Sequence[float], quaternion: Sequence[float]) -> F64:
    """(4, 4) of a translation and a quaternion (x, y, z, w) of any length but zero; NaN for that."""
    q = np.asarray(quaternion, dtype=np.float64)
    length = np.linalg.norm(q)
    x, y, z, w = q / length if length > 0 else np.full(4, np.nan)
    pose = np.eye(4)
    pose[:3, :3] = [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                    [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                    [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    pose[:3, 3] = translation
    return pose
