"""Contributions of one view to the 64 voxels of a cell, and the values that result (SEMANTICS 2).

A cell is evaluated in three passes: pixel and z of each voxel, the reads of the depth map, and the encoding's
own rule. The first and last compile to vector code; kept in one loop with the reads, neither would, as the
compiler cannot tell that a read does not alias a result. Everything is float64 and no operation is
reassociated: results do not depend on the machine's vector width, and pixels are those of float64 rounding.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ocnf_data.arrays import F32, F64, I32
from ocnf_data.fusion.projection import CELL

CELL_VOXELS = CELL**3
N_BINS = 10

TSDF, TDF_OCCUPANCY, HISTOGRAM, OCCUPANCY = 0, 1, 2, 3


@njit(cache=True, nogil=True, error_model="numpy")
def project(camera: F64, offsets: F64, z: int, y: int, x: int, pixels: I32, depths: F64,
            size: tuple[int, int]) -> None:
    """Pixel index and z_c of the voxels of the cell at (z, y, x), all of which fall into the image."""
    u0 = camera[0] * x + camera[1] * y + camera[2] * z + camera[3]
    v0 = camera[4] * x + camera[5] * y + camera[6] * z + camera[7]
    z0 = camera[8] * x + camera[9] * y + camera[10] * z + camera[11]
    cu, cv = camera[12], camera[13]
    width = np.int32(size[1])
    for i in range(CELL_VOXELS):
        depth = z0 + offsets[2, i]
        inverse = 1.0 / depth
        u = np.int32((u0 + offsets[0, i]) * inverse + cu)  # truncation is floor: both are >= 0
        v = np.int32((v0 + offsets[1, i]) * inverse + cv)
        pixels[i] = v * width + u
        depths[i] = depth


@njit(cache=True, nogil=True, error_model="numpy")
def project_edge(camera: F64, offsets: F64, z: int, y: int, x: int, pixels: I32, depths: F64,
                 size: tuple[int, int]) -> None:
    """`project` for any cell; the pixel is -1 for voxels outside the image or not before the camera."""
    height, width = size
    u0 = camera[0] * x + camera[1] * y + camera[2] * z + camera[3]
    v0 = camera[4] * x + camera[5] * y + camera[6] * z + camera[7]
    z0 = camera[8] * x + camera[9] * y + camera[10] * z + camera[11]
    for i in range(CELL_VOXELS):
        depth = z0 + offsets[2, i]
        depths[i] = depth
        pixels[i] = -1
        if depth > 0:
            inverse = 1.0 / depth
            u = (u0 + offsets[0, i]) * inverse + camera[12]
            v = (v0 + offsets[1, i]) * inverse + camera[13]
            if u >= 0 and v >= 0 and u < width and v < height:
                pixels[i] = np.int32(v) * np.int32(width) + np.int32(u)


@njit(cache=True, nogil=True, error_model="numpy")
def read(image: F32, pixels: I32, measured: F64) -> None:
    """Depth of the pixels in metres; 0, no measurement, where there is no pixel."""
    for i in range(CELL_VOXELS):
        pixel = pixels[i]
        measured[i] = image[np.uint64(pixel)] if pixel >= 0 else np.float32(0)


@njit(cache=True, nogil=True, error_model="numpy")
def add_tsdf(measured: F64, depths: F64, truncation: float, totals: F64, counts: F64) -> None:
    """Add min(dist / tau, 1) with weight 1 where dist >= -tau."""
    scale = 1.0 / truncation
    for i in range(CELL_VOXELS):
        distance = measured[i] - depths[i]
        valid = (distance >= -truncation) & (measured[i] > 0)
        totals[i] += min(distance * scale, 1.0) if valid else 0.0
        counts[i] += 1.0 if valid else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def add_votes(measured: F64, depths: F64, truncation: float, votes: F64, counts: F64) -> None:
    """Add one vote to the bins (64, 10), split linearly between the two nearest centres."""
    for i in range(CELL_VOXELS):
        distance = measured[i] - depths[i]
        if distance >= -truncation and measured[i] > 0:
            # Bin centres are w = tau / 4 apart, the first at -tau - w / 2.
            place = min(4.0 * distance / truncation + 4.5, N_BINS - 1.0)
            low = min(int(place), N_BINS - 2)
            votes[i, low] += 1.0 - (place - low)
            votes[i, low + 1] += place - low
            counts[i] += 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def add_sight(measured: F64, depths: F64, threshold: float, counts: F64) -> None:
    """Count the views that see more than `threshold` metres past a voxel."""
    for i in range(CELL_VOXELS):
        seen = (measured[i] - depths[i] > threshold) & (measured[i] > 0)
        counts[i] += 1.0 if seen else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def write_cell(kind: int, totals: F64, votes: F64, counts: F64, n_free: int, out: F32) -> None:
    """Values of a cell into `out` (4, 4, 4, C) float32; `n_free` more views saw all of it to be free."""
    for i in range(CELL_VOXELS):
        value = out[i // 16, i // 4 % 4, i % 4]
        count = counts[i] + n_free
        if kind == OCCUPANCY:
            value[0] = 0.0 if count > 0 else 1.0
        elif kind == HISTOGRAM:
            if count == 0:
                value[:] = 0.0
                value[0] = 1.0
            else:
                votes[i, N_BINS - 1] += n_free
                for j in range(N_BINS):
                    value[j] = votes[i, j] / count
        else:
            tsdf = np.float32((totals[i] + n_free) / count) if count > 0 else np.float32(-1.0)
            if kind == TSDF:
                value[0] = tsdf
            else:
                value[0] = abs(tsdf)
                value[1] = 1.0 if tsdf < 0 else 0.0
