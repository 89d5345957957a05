"""The structure module: finer cells near the reconstructed surface (paper section 3.3, SEMANTICS 4)."""

from __future__ import annotations

import math

from ocnf_data.errors import OcnfError
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.resample import doubled
from ocnf_model.octree.structure import Structure
from ocnf_model.ops.near_surface import surface_trees


def split_surface(
    features: OctreeBatch, reconstruction: OctreeBatch, band: float = 1,
    guide: OctreeBatch | Structure | None = None, threshold: float = 0.0,
) -> OctreeBatch:
    """Features at twice the resolution, on a structure that is refined near the surface.

    A voxel becomes eight leaves iff some voxel within Chebyshev distance ceil(band / 2) lies on the other
    side of the surface; all else is the unpooled leaves of `features`, split as far as needed to hold them.
    The union with the guide's structure is taken. Differentiable in the features, not in the reconstruction.

    Args:
        features: any channels.
        reconstruction: octrees of 1 channel and the same size; their structure may be another one.
        band: width of the band that is split, in voxels of the finer resolution, at least 0 (0 splits
            nothing).
        guide: octrees at twice the resolution of `features`.
        threshold: what separates the sides, value < threshold from value >= threshold: 0 for a TSDF, 0.5
            for occupancy.

    Raises:
        OcnfError: the sizes do not fit, or the reconstruction has several channels.
    """
    if reconstruction.channels != 1:
        raise OcnfError("a reconstruction has one channel", where="split_surface", field="reconstruction",
                        found=reconstruction.channels, expected=1)
    if not (isinstance(band, float | int) and 0 <= band < math.inf):
        raise OcnfError("not a band", where="split_surface", field="band", found=band, expected="0 or more")
    features.structure.check_same_grid(reconstruction.structure, "split_surface")
    structure = surface_structure(features.structure, reconstruction, math.ceil(band / 2), threshold)
    if guide is not None:
        structure = structure.union(guide.structure if isinstance(guide, OctreeBatch) else guide)
    return OctreeBatch(structure, features.map_to(structure)(features.features))


def surface_structure(base: Structure, reconstruction: OctreeBatch, reach: int,
                      threshold: float) -> Structure:
    """The unpooled `base`, with voxels within `reach` of the other side split into eight."""
    where = reconstruction.structure
    below = (reconstruction.features.detach()[:, 0] < threshold).cpu().numpy()  # (L,) bool
    unpooled = doubled(base)
    split = surface_trees(where.flat, where.prefix, where.grid, below, reach)  # (8 T, 2)
    return Structure(unpooled.trees | split.reshape(unpooled.trees.shape))  # (B, 2 GD, 2 GH, 2 GW, 2)
