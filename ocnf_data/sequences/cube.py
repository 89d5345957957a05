"""The part of a scan that is fused, and the scan moved and scaled into the cube of the data set."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid, fuse_tsdf
from ocnf_data.sequences import Box
from ocnf_data.views.cameras import Views
from ocnf_data.views.normalisation import Normalisation

_SEARCH_RESOLUTION = 128
_SEARCH_POINTS = 200_000
_OUTLIERS = 0.2  # per cent of the points at either end of an axis that do not stretch the search
_SEARCH_MARGIN = 0.1


def object_box(views: Views | DepthPyramid) -> Box:
    """The box around the largest connected surface, as `ocnf-model fuse` takes it.

    All views are fused into a coarse TSDF (128 voxels) over the bounds of all measured points. A voxel
    belongs to a surface where the TSDF is neither free nor unseen; voxels that touch, if only at a corner,
    belong together, and the largest surface is the one of most voxels. What an object stands on is part of
    it: an object on a table needs a box of its own.

    Raises:
        OcnfError: nothing was measured (`empty`).
    """
    from scipy.ndimage import find_objects, label

    pyramid = views if isinstance(views, DepthPyramid) else DepthPyramid(views)
    low, high = measured_bounds(measured_points(pyramid.views))
    size = max(float((high - low).max()) * (1 + 2 * _SEARCH_MARGIN), 1e-6)
    x, y, z = ((low + high) / 2).tolist()
    octree = fuse_tsdf(pyramid, _SEARCH_RESOLUTION, size, centre=(x, y, z))
    labels, n = label(np.abs(octree.to_dense()[0]) < 1, np.ones((3, 3, 3)))
    if n == 0:
        raise OcnfError("no surface was found in the scan", code="empty", where="the scan")
    largest = int(np.bincount(labels.ravel())[1:].argmax())
    spans = find_objects(labels)[largest][::-1]  # of z, y, x
    corners = [(at - _SEARCH_RESOLUTION / 2) * size / _SEARCH_RESOLUTION + middle
               for ends in ([span.start for span in spans], [span.stop for span in spans])
               for at, middle in zip(ends, (x, y, z), strict=True)]
    x0, y0, z0, x1, y1, z1 = map(float, corners)
    return x0, y0, z0, x1, y1, z1


def box_of_cube(cube: tuple[Sequence[float], float], padding: float) -> Box:
    """The box whose padded cube is the one of that (centre, edge length in metres)."""
    (x, y, z), size = cube
    half = size * (1 - padding) / 2
    return x - half, y - half, z - half, x + half, y + half, z + half


def into_cube(box: Box, extent: float, padding: float) -> Normalisation:
    """The map that takes a box of the scan into the data set's cube, as meshes are taken there.

    The box's centre goes to the origin, and its longest edge becomes `(1 - padding) * extent`.
    """
    low, high = np.array(box[:3]), np.array(box[3:])
    return Normalisation((low + high) / 2, (1 - padding) * extent / float((high - low).max()))


def placed(views: Views, normalisation: Normalisation) -> Views:
    """Views of the scan as views of the moved and scaled scan: what they show is the same.

    With X' = s (X - c), s X_c = R X' + s (R c + T): depths and translations are scaled, rotations stay.
    """
    scale, centre = normalisation.scale, normalisation.centre
    return Views(views.depth * np.float32(scale), views.K, views.R, scale * (views.R @ centre + views.T))


def looks_into(views: Views, extent: float) -> bool:
    """Whether some measurement of placed views lies in the cube."""
    points = measured_points(views)
    return bool((np.abs(points) <= extent / 2).all(axis=1).any())


def measured_bounds(points: F64) -> tuple[F64, F64]:
    """Ends (x, y, z) of the box around points (N, 3), but for 0.2 % of them at either end of each axis.

    Raises:
        OcnfError: there are none (`empty`).
    """
    if not len(points):
        raise OcnfError("nothing was measured in any frame", code="empty", where="the scan",
                        fix="check the depth scale, the crop and the largest depth that is used")
    low, high = np.percentile(points, [_OUTLIERS, 100 - _OUTLIERS], axis=0)
    return low, high


def measured_points(views: Views) -> F64:
    """World positions (N, 3) of some of the pixels that hit something, spread over all views."""
    height, width = views.size
    step = max(1, int(np.sqrt(views.depth.size / _SEARCH_POINTS)))
    v, u = (axis.ravel() for axis in np.mgrid[:height:step, :width:step])
    points = [np.empty((0, 3))]
    for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
        z = depth[v, u].astype(np.float64)
        hit = (z > 0) & np.isfinite(z)
        z = z[hit]
        camera = np.stack([(u[hit] - K[0, 2]) / K[0, 0] * z, (v[hit] - K[1, 2]) / K[1, 1] * z, z], axis=1)
        points.append((camera - T) @ R)
    return np.concatenate(points)
