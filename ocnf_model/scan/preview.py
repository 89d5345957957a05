"""A picture of what is going to be fused: the region's box over the measured points and the cameras."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.files.storage import Store
from ocnf_data.render.pictures import draw_depth
from ocnf_data.sequences.cube import measured_points
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import Scan
from ocnf_model.scan.region import Region

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POINTS = 40_000
_PANELS = ((0, 1, "seen along z"), (0, 2, "seen along y"), (1, 2, "seen along x"))
_BOX = "#c1121f"
_INSIDE, _OUTSIDE = "#2a6f97", "#c9c9c9"
_NEAR = 0.05  # metres before a camera from which on the box is drawn into its picture


def draw_preview(scan: Scan, region: Region, path: Path) -> None:
    """Draw three projections along the axes of the scan's coordinates, and the box in a frame.

    Points are blue in the box and grey outside; cameras are black, with a line to where they look.

    Args:
        scan: posed depth.
        region: its box is drawn.
        path: of the PNG.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    points = measured_points(scan.views)
    points = points[:: max(len(points) // _POINTS, 1)]
    figure = Figure(figsize=(12, 10.5), layout="constrained")
    axes = figure.subplots(2, 2)
    for ax, (i, j, title) in zip(axes.flat, _PANELS, strict=False):
        _draw_projection(ax, points, scan.views, region, (i, j))
        ax.set_title(title, fontsize=10)
    frame = _best_frame(scan.views, region)
    _draw_frame(axes[1, 1], scan.views, region, frame)
    axes[1, 1].set_title(f"{scan.names[frame]}: depth, and the box", fontsize=10)
    lengths = " x ".join(f"{b - a:.3g}" for a, b in zip(region.low, region.high, strict=True))
    inside = region.holds(points).mean() if len(points) else 0.0
    figure.suptitle(f"--{region}\n{lengths} m, {inside:.0%} of what {len(scan.views)} frames measured",
                    fontsize=11)
    with Store(path.parent).writing(path.name) as file, file.open("wb") as stream:
        FigureCanvasAgg(figure).print_png(stream)


def _draw_projection(ax: Axes, points: F64, views: Views, region: Region, shown: tuple[int, int]) -> None:
    """Points, cameras and box on two of the axes x, y, z."""
    from matplotlib.patches import Rectangle

    i, j = shown
    inside = region.holds(points)
    for which, colour in ((~inside, _OUTSIDE), (inside, _INSIDE)):
        ax.scatter(points[which, i], points[which, j], s=0.6, c=colour, linewidths=0, rasterized=True)
    centres = views.centres
    reach = 0.05 * float(np.ptp(np.concatenate([points, centres]), axis=0).max())
    ahead = centres + reach * views.R[:, 2]
    ax.plot(np.stack([centres[:, i], ahead[:, i]]), np.stack([centres[:, j], ahead[:, j]]), c="black", lw=0.7)
    ax.scatter(centres[:, i], centres[:, j], s=7, c="black")
    low, high = region.low, region.high
    ax.add_patch(Rectangle((low[i], low[j]), high[i] - low[i], high[j] - low[j], fill=False, ec=_BOX, lw=1.8))
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel(f"{'xyz'[i]}, metres")
    ax.set_ylabel(f"{'xyz'[j]}, metres")
    ax.grid(lw=0.3)


def _best_frame(views: Views, region: Region) -> int:
    """The frame in whose picture most of the box's corners lie; of several the middle one."""
    height, width = views.size
    counts = []
    for K, R, T in zip(views.K, views.R, views.T, strict=True):
        at, z = _project(_corners(region), K, R, T)
        counts.append(int(((z > 0) & (at >= 0).all(axis=1) & (at < (width, height)).all(axis=1)).sum()))
    best = np.flatnonzero(np.array(counts) == max(counts))
    return int(best[len(best) // 2])


def _draw_frame(ax: Axes, views: Views, region: Region, frame: int) -> None:
    """A depth map with the edges of the box that lie before the camera."""
    depth = views.depth[frame]
    hit = depth[(depth > 0) & np.isfinite(depth)]
    limits = (float(np.percentile(hit, 1)), float(np.percentile(hit, 99))) if hit.size else (0.0, 1.0)
    draw_depth(ax, depth, limits)
    corners = _corners(region)
    for a, b in itertools.combinations(range(8), 2):
        if (a ^ b).bit_count() != 1:
            continue
        line = corners[a] + np.linspace(0, 1, 64)[:, None] * (corners[b] - corners[a])
        at, z = _project(line, views.K[frame], views.R[frame], views.T[frame])
        at[z < _NEAR] = np.nan
        for colour, breadth in (("black", 3.2), ("white", 1.6)):  # seen on any depth
            ax.plot(at[:, 0], at[:, 1], c=colour, lw=breadth)
    height, width = views.size
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)


def _corners(region: Region) -> F64:
    """(8, 3) corners; bit k of the number says which end of axis k."""
    ends = np.array([region.low, region.high])
    return np.array([[ends[n >> axis & 1, axis] for axis in range(3)] for n in range(8)])


def _project(points: F64, K: F64, R: F64, T: F64) -> tuple[F64, F64]:
    """Pixels (N, 2) and z (N,) of points (N, 3); pixels behind the camera mean nothing."""
    x, y, z = R @ points.T + T[:, None]
    safe = np.where(z > 1e-9, z, 1e-9)
    return np.stack([K[0, 0] * x / safe + K[0, 2], K[1, 1] * y / safe + K[1, 2]], axis=1), z
