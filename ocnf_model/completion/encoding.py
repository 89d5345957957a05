"""What the network reads of a single view, and what it is to learn, as volumes of the finest resolution."""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F32
from ocnf_model.completion.extrusion import Sweeps
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST, TRUNCATION, Visible

CHANNELS = 6
"""Channels of `encode_view`: the one of a TSDF, and five that are zero wherever the view sees free space."""
FREE_SPACE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""What free space holds, and what lies around a scene's grid."""
TABLE = (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""What lies below the lowest voxels that are judged."""
UNKNOWN = -1.0
"""Value of `targets` where a voxel has no loss."""
_FARTHEST = 0.4  # metres: distances and heights are divided by it


def encode_view(scene: Tabletop, visible: Visible) -> F32:
    """(CHANNELS, D, H, W) float32 in [-1, 1], of the view alone:

    | channel | holds                                                                                |
    |---------|--------------------------------------------------------------------------------------|
    | 0       | TSDF / `TRUNCATION` behind the surface, -1 where unknown, 1 in free space            |
    | 1       | distance behind the visible surface along the camera's axis, / 0.4 m, at most 1      |
    | 2       | 1 where nothing was measured, or outside of the image                                |
    | 3       | height above the grid's floor / 0.4 m, at most 1; 0 outside of the image              |
    | 4       | 1 where a visible point lies straight above (`Sweeps.above`)                         |
    | 5       | share of the four horizontal main directions in which one does (`Sweeps.beside`)     |

    How far free space is from the surface says nothing of what is hidden, and what lies below the lowest
    voxels that are judged is the table: both are constant, so that their octrees are coarse.
    """
    hidden = ~visible.free
    sweeps = Sweeps.of(scene, visible)
    out = np.zeros((CHANNELS, *scene.shape), np.float32)
    out[0] = np.where(np.isnan(visible.tsdf), -1, np.where(visible.free, 1, visible.tsdf / TRUNCATION))
    out[1] = np.where(visible.measured & hidden, np.clip(visible.behind / _FARTHEST, 0, 1), 0)
    out[2] = ~visible.measured
    height = (np.arange(scene.shape[0]) + 0.5) * scene.voxel / _FARTHEST
    out[3] = np.where(hidden & visible.in_image, np.clip(height, 0, 1)[:, None, None], 0)
    out[4] = sweeps.above
    out[5] = sweeps.beside / 4
    out[:, :LOWEST] = np.array(TABLE, np.float32)[:, None, None, None]
    return out


def targets(scene: Tabletop, visible: Visible) -> F32:
    """(D, H, W) float32: 1 occupied, 0 free, `UNKNOWN` where the metric does not look nor the view see.

    Voxels that the metric judges are as in its ground truth, in which unknown ones count as occupied: they
    are the insides of things, which no camera sees. What the view sees to be free is free.
    """
    out = np.full(scene.shape, UNKNOWN, np.float32)
    free = visible.free
    free[:LOWEST] = False
    out[free] = 0
    judged = visible.judged
    out[judged] = scene.occupied[judged]
    return out


def coarser(volume: F32) -> F32:
    """(C, D, H, W) of even sizes to half of it: the mean of each eight voxels."""
    channels, depth, height, width = volume.shape
    eights = volume.reshape(channels, depth // 2, 2, height // 2, 2, width // 2, 2)
    return np.asarray(eights.mean(axis=(2, 4, 6), dtype=np.float32))


def coarser_targets(volume: F32) -> F32:
    """(D, H, W) targets at half the resolution: the mean of the known voxels, unknown if fewer than half."""
    known = coarser((volume >= 0).astype(np.float32)[None])[0]
    total = coarser(np.maximum(volume, 0)[None])[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known >= 0.5, total / known, UNKNOWN).astype(np.float32)
