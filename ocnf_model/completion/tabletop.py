"""A tabletop scene seen once: the one thing that readers and generators hand to methods and metric."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F32, Bool
from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import Views


@dataclass(frozen=True, eq=False)
class Tabletop:
    """One depth map of a scene, and what is known of the scene's volume.

    The grid is axis-aligned with z up and one corner at the origin: the centre of voxel (z, y, x) lies at
    `((x, y, z) + 0.5) * voxel` in the world of the view.

    Attributes:
        name: name of the scene and the frame, for tables.
        view: one depth map with its camera, in metres.
        voxel: edge length of a voxel in metres.
        tsdf: (D, H, W) float32 metres, negative inside, NaN where the scene is not known. D is along z, H
            along y, W along x; any sizes.

    Raises:
        OcnfError: several views, a volume that is none, an edge length that is not positive.
    """

    name: str
    view: Views
    voxel: float
    tsdf: F32

    def __post_init__(self) -> None:
        """Check the parts."""
        if len(self.view) != 1:
            raise OcnfError("completion starts from a single view", where=self.name, field="view",
                            found=f"{len(self.view)} views", expected=1)
        if self.tsdf.ndim != 3 or self.tsdf.size == 0:
            raise OcnfError("not a volume", where=self.name, field="tsdf", found=self.tsdf.shape,
                            expected="(D, H, W)")
        if not (np.isfinite(self.voxel) and self.voxel > 0):
            raise OcnfError("not a length", where=self.name, field="voxel", found=self.voxel,
                            expected="metres > 0")

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, H, W) in voxels."""
        depth, height, width = self.tsdf.shape
        return depth, height, width

    @property
    def known(self) -> Bool:
        """(D, H, W): where the ground truth says something."""
        return ~np.isnan(self.tsdf)

    @property
    def occupied(self) -> Bool:
        """(D, H, W): the ground truth of the metric, in which unknown voxels count as occupied."""
        return ~(self.tsdf >= 0)
