"""What one depth map says of a volume: its TSDF, and the voxels that completion is judged on.

Both are those of Firman et al. 2016 (Structured Prediction of Unobserved Voxels From a Single Depth Image),
to the letter: nearest pixels, distances along the camera's z axis, 25 mm of truncation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F32, F64, Bool
from ocnf_data.views.cameras import Views

TRUNCATION = 0.025
"""Metres to both sides of the surface within which the TSDF of a single view is known."""
LOWEST = 6
"""The lowest z index that is judged: what lies below is the table."""


@dataclass(frozen=True, eq=False)
class Visible:
    """The volume as one view sees it.

    Attributes:
        tsdf: (D, H, W) float32 metres, `-clip(z_voxel - depth, -0.025, 0.025)`; NaN where unknown: more than
            0.025 behind the surface, outside of the image, behind the camera, or without a measurement.
        in_image: (D, H, W): whether the voxel's centre projects to a pixel, measured or not.
        measured: (D, H, W): whether it projects to a pixel with a measurement.
        behind: (D, H, W) float32 metres behind the surface, negative before it; 0 where not measured.
    """

    tsdf: F32
    in_image: Bool
    measured: Bool
    behind: F32

    @classmethod
    def of(cls, view: Views, shape: tuple[int, int, int], voxel: float) -> Visible:
        """Look at each voxel of a grid with its corner at the origin, in the view's only depth map.

        Args:
            view: one view; depth 0 is no measurement, `inf` a free ray.
            shape: (D, H, W) in voxels.
            voxel: edge length of a voxel in metres.
        """
        u, v, z = project_voxels(view, shape, voxel)
        rows, columns = view.size
        ahead = z > 0
        in_image = ahead & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        depth = np.zeros(shape, np.float32)
        depth[in_image] = view.depth[0][v[in_image].astype(np.int64), u[in_image].astype(np.int64)]
        measured = depth > 0
        behind = np.where(measured, z - depth, 0)
        known = measured & (behind <= TRUNCATION)
        tsdf = np.where(known, -np.clip(behind, -TRUNCATION, TRUNCATION), np.nan).astype(np.float32)
        return cls(tsdf, in_image, measured, behind.astype(np.float32))

    @property
    def free(self) -> Bool:
        """(D, H, W): seen to be in front of the surface."""
        return self.tsdf >= 0  # NaN is not

    @property
    def judged(self) -> Bool:
        """(D, H, W): what the metric counts: in the image, not known to be free, and above the table."""
        judged = self.in_image & ~self.free
        judged[:LOWEST] = False
        return judged


def project_voxels(view: Views, shape: tuple[int, int, int], voxel: float) -> tuple[F64, F64, F64]:
    """Column u and row v of the nearest pixel (whole numbers as float64), and z in metres; each (D, H, W)."""
    z, y, x = ((np.arange(n) + 0.5) * voxel for n in shape)
    R, T, K = view.R[0], view.T[0], view.K[0]
    a, b, depth = (R[i, 0] * x + R[i, 1] * y[:, None] + R[i, 2] * z[:, None, None] + T[i] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.rint(K[0, 0] * a / depth + K[0, 2])
        v = np.rint(K[1, 1] * b / depth + K[1, 2])
    return u, v, depth
