"""The surface that reconstructions are measured against: the mesh's own, or the ground truth's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from ocnf_data.arrays import F64, Bool
from ocnf_data.octree import GridOctree
from ocnf_data.views.cameras import Views
from ocnf_model.measures.surface import N_SAMPLES, Samples, Surface, sample_triangles
from ocnf_model.measures.thickness import local_thickness

_FOR_DISTANCES = 4 * N_SAMPLES  # of a mesh, whose triangles may be large


@dataclass(frozen=True, eq=False)
class Reference:
    """What is true of a surface.

    Attributes:
        surface: the triangles that distances are measured to.
        samples: N points spread evenly over its area.
        thickness: (N,) local thickness at them in metres, see `local_thickness`.
    """

    surface: Surface
    samples: Samples
    thickness: F64

    @classmethod
    def of_truth(cls, truth: GridOctree, extent: float, longest: float) -> Self:
        """The surface of a ground truth, by marching cubes.

        Args:
            truth: TSDF / tau, or 1 - 2 occupancy, at the finest resolution that there is.
            extent: size of the cube in metres.
            longest: largest thickness in metres; one above is infinite.
        """
        surface = Surface.of_octree(truth, extent)
        samples = surface.samples
        return cls(surface, samples, local_thickness(truth, samples.points, samples.normals, longest, extent))

    @classmethod
    def of_mesh(cls, triangles: F64, views: Views, truth: GridOctree, extent: float, longest: float) -> Self:
        """The part of a mesh that a view of the rig sees; what is hidden within the mesh no one can know.

        A sample counts as seen if the depth at its pixel is its own to within a voxel of the ground truth.

        Args:
            triangles: (M, 3, 3) float64 of the normalised mesh, metres, in any winding.
            views: all views of the rig, without noise.
            truth: the ground truth, which the thickness is measured in, as for `of_truth`.
            extent: size of the cube in metres.
            longest: largest thickness in metres; one above is infinite.
        """
        many = sample_triangles(triangles, _FOR_DISTANCES)
        many = many.chosen(visible(many.points, views, extent / max(truth.shape)))
        surface = Surface.around(many, triangles)
        few = many.chosen(np.arange(0, len(many), max(len(many) // N_SAMPLES, 1)))
        return cls(surface, few, local_thickness(truth, few.points, few.normals, longest, extent))


def visible(points: F64, views: Views, tolerance: float) -> Bool:
    """(N,): whether some view's depth at the pixel of a point (N, 3) is the point's z to within metres."""
    found = np.zeros(len(points), bool)
    height, width = views.size
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        left = np.flatnonzero(~found)
        x, y, z = (R @ points[left].T + T[:, None])
        front = z > 0
        left, x, y, z = left[front], x[front], y[front], z[front]
        u = np.floor(K[0, 0] * x / z + K[0, 2] + 0.5).astype(np.int64)
        v = np.floor(K[1, 1] * y / z + K[1, 2] + 0.5).astype(np.int64)
        within = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        found[left[within]] = np.abs(depth[v[within], u[within]] - z[within]) <= tolerance
    return found
