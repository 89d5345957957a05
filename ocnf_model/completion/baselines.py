"""What can be said of the hidden part of a scene without learning.

Each method takes a `Tabletop` and gives (D, H, W) bool, occupied or not; what is not judged is arbitrary.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ocnf_data.arrays import Bool
from ocnf_data.fusion import default_truncation, fuse_tsdf
from ocnf_model.completion.extrusion import extrude
from ocnf_model.completion.padding import grid_placement, padded_shape
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import Visible


def all_occupied(scene: Tabletop) -> Bool:
    """All that is not seen to be free."""
    return np.ones(scene.shape, bool)


def visible_band(scene: Tabletop) -> Bool:
    """The 25 mm behind what is seen."""
    return np.asarray(Visible.of(scene.view, scene.shape, scene.voxel).tsdf < 0)


def single_view_tsdf(scene: Tabletop) -> Bool:
    """TSDF fusion (VolFus) of the one view, with the paper's tau of 2.1333 voxels; unseen counts as empty."""
    shape = padded_shape(scene.shape)
    extent, centre = grid_placement(shape, scene.voxel)
    fused = fuse_tsdf(scene.view, shape, extent, default_truncation(shape, extent), centre=centre)
    depth, height, width = scene.shape
    values = fused.to_dense()[0, :depth, :height, :width]
    return np.asarray((values < 0) & (values > -1))  # exactly -1 is unseen


METHODS: dict[str, Callable[[Tabletop], Bool]] = {
    "everything occupied": all_occupied,
    "visible band": visible_band,
    "single-view TSDF": single_view_tsdf,
    "extrusion": extrude,
}
"""The methods by the names that tables have."""
