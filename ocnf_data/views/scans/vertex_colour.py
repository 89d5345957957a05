"""Colour for the vertices of a fused mesh, from the frames that see them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numba import njit, prange

from ocnf_data.arrays import F32, F64, U8, Bool
from ocnf_data.errors import OcnfError
from ocnf_data.views.scans.scan import Scan

_NEAR_AN_EDGE = np.float32(0.05)  # weight of a view in which something nearer is a pixel away
_GREY = 128


def vertex_colours(points: F64, scan: Scan, band: float, normals: F64 | None = None,
                   fault: Callable[[OcnfError], None] | None = None) -> tuple[U8, Bool]:
    """Red, green, blue (N, 3) uint8 of points on a surface, and which of them (N,) some frame sees.

    A frame sees a point where it measured a depth within `band` of the point's. Its colour is taken by
    bilinear interpolation and weighed by 1 / z^2, the number of pixels that a patch of the surface covers,
    and by the cosine of the viewing angle; a frame in which the point lies beside a nearer surface counts
    little, because colour and depth are never registered exactly there. A point that no frame sees has the
    colour of the nearest one that is seen, or grey where there is none.

    Args:
        points: (N, 3) world coordinates in metres.
        scan: a scan that has colour.
        band: metres, about the truncation that the points were fused with.
        normals: (N, 3) unit vectors of the surface, outwards; None: the angle does not count.
        fault: told of each image that cannot be read, whose frame then has no colour; None: it is raised.

    Raises:
        OcnfError: the scan has no colour, or, without `fault`, an image of it cannot be read.
    """
    colour = scan.colour
    if colour is None:
        raise OcnfError("the scan has no colour", code="missing", where="vertex_colours", field="scan")
    total = np.zeros((len(points), 4), np.float32)
    directions = np.zeros((0, 3)) if normals is None else np.ascontiguousarray(normals, dtype=np.float64)
    views, at = scan.views, np.ascontiguousarray(points, dtype=np.float64)
    for i in range(len(views)):
        try:
            image = colour.image(i)
        except OcnfError as error:
            if fault is None:
                raise
            fault(error)
            continue
        if image is not None:
            _add_view(at, directions, views.depth[i], np.stack([views.K[i], colour.K[i]]),
                      np.column_stack([views.R[i], views.T[i]]), image, band, total)
    seen = total[:, 3] > 0
    mixed = np.full((len(points), 3), _GREY, np.uint8)
    mixed[seen] = np.rint(total[seen, :3] / total[seen, 3:]).astype(np.uint8)
    if seen.any() and not seen.all():
        from scipy.spatial import cKDTree

        _, nearest = cKDTree(at[seen]).query(at[~seen])
        mixed[~seen] = mixed[seen][nearest]
    return mixed, seen


def colour_notes(faults: Sequence[OcnfError], n: int) -> list[str]:
    """Sentences on the images that cannot be used, each with an example, of a scan of n frames."""
    missing = [error.where for error in faults if error.code == "missing"]
    others = [" ".join(str(error).split()) for error in faults if error.code != "missing"]
    found = []
    if missing:
        found.append(f"{len(missing)} of {n} frames are without their colour: the images are not there "
                     f"({missing[0]})")
    if others:
        found.append(f"{len(others)} of {n} frames are without their colour ({others[0]})")
    return found


@njit(cache=True, nogil=True, parallel=True)
def _add_view(points: F64, normals: F64, depth: F32, pinholes: F64, pose: F64, image: U8, band: float,
              total: F32) -> None:
    """Add a view's weighed colours to `total` (N, 4): r, g, b, weight.

    `pinholes`: K of depth and colour; `pose`: (3, 4), world to camera.
    """
    R, T = pose[:, :3], pose[:, 3]
    height, width = depth.shape
    rows, columns = image.shape[0], image.shape[1]
    k, c = pinholes[0], pinholes[1]
    for i in prange(len(points)):
        p = points[i]
        z = R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + T[2]
        if z <= 0:
            continue
        x = R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2] + T[0]
        y = R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2] + T[1]
        u, v = np.floor(k[0, 0] * x / z + k[0, 2] + 0.5), np.floor(k[1, 1] * y / z + k[1, 2] + 0.5)
        cu, cv = c[0, 0] * x / z + c[0, 2], c[1, 1] * y / z + c[1, 2]
        if not (0 <= u < width and 0 <= v < height and 0 <= cu <= columns - 1 and 0 <= cv <= rows - 1):
            continue
        row, column = int(v), int(u)
        if not (depth[row, column] > 0 and abs(depth[row, column] - z) <= band):
            continue
        weight = np.float32(1 / (z * z))
        if len(normals):
            n = normals[i]
            nx = R[0, 0] * n[0] + R[0, 1] * n[1] + R[0, 2] * n[2]
            ny = R[1, 0] * n[0] + R[1, 1] * n[1] + R[1, 2] * n[2]
            nz = R[2, 0] * n[0] + R[2, 1] * n[1] + R[2, 2] * n[2]
            cosine = -(nx * x + ny * y + nz * z) / np.sqrt(x * x + y * y + z * z)
            weight *= np.float32(max(cosine, 0.05))
        for a in range(max(row - 1, 0), min(row + 2, height)):
            for b in range(max(column - 1, 0), min(column + 2, width)):
                if 0 < depth[a, b] < z - band:
                    weight = min(weight, _NEAR_AN_EDGE / np.float32(z * z))
        left, top = min(int(cu), columns - 2), min(int(cv), rows - 2)
        du, dv = np.float32(cu - left), np.float32(cv - top)
        for channel in range(3):
            upper = image[top, left, channel] * (1 - du) + image[top, left + 1, channel] * du
            lower = image[top + 1, left, channel] * (1 - du) + image[top + 1, left + 1, channel] * du
            total[i, channel] += weight * (upper * (1 - dv) + lower * dv)
        total[i, 3] += weight


def vertex_normals(vertices: F64, faces: np.ndarray) -> F64:
    """Unit normals (N, 3) of a mesh's vertices, faces (M, 3) weighed by their area; 0 where there is none."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(faces[:, corner], across[:, axis], len(vertices))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.divide(normals, length, out=np.zeros_like(normals), where=length > 0))
