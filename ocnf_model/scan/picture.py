"""The surfaces of several methods side by side, as a person would look at them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ocnf_data.arrays import F64, U8
from ocnf_data.files.storage import Store
from ocnf_data.render.shade import shade, shade_view
from ocnf_data.views.cameras import Views, resized
from ocnf_data.views.scans import Scan
from ocnf_model.evaluation.methods import Method
from ocnf_model.scan.reconstruction import Reconstruction

_PIXELS = 640
_INCHES = 4.6
_TRIED = 40  # frames, of which two are drawn from
_POINTS = 20_000
_TURN = 30.0  # degrees around the object from where the cameras stand
_APART = np.cos(np.deg2rad(50))  # of the directions of the two frames


def draw_comparison(results: Sequence[Reconstruction], scan: Scan, path: Path) -> None:
    """Draw each surface from a frame of the scan, and from another side.

    The first is the frame that sees most of the first surface. The other side is from outside, a little
    around and above the cameras; where the cameras stand inside the region, as in a room, another frame's.

    Args:
        results: the surfaces, in the order of the columns.
        scan: whose cameras are used.
        path: of the PNG.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    frames = _two_frames(results[0].vertices, scan.views)
    rows = [(scan.names[i], [shade_view(r.vertices, r.faces, _camera(scan.views, i)) for r in results])
            for i in frames]
    centres = scan.views.centres
    if not results[0].region.holds(centres).any():
        rows[1] = ("from the side", _trimmed(_from_the_side(results, scan.views, centres)))
    heights = [images[0].shape[0] / images[0].shape[1] for _, images in rows]
    figure = Figure(figsize=(_INCHES * len(results) + 0.3, _INCHES * sum(heights) + 1.0), dpi=150,
                    layout="constrained")
    axes = figure.subplots(2, len(results), squeeze=False, height_ratios=heights)
    for row, (name, images) in enumerate(rows):
        for column, (result, image) in enumerate(zip(results, images, strict=True)):
            ax = axes[row, column]
            ax.imshow(image, interpolation="lanczos")
            ax.set_xticks([])
            ax.set_yticks([])
            ax.spines[:].set_visible(False)
            if row == 0:
                loose = f", {result.loose:,} loose parts dropped" if result.loose else ""
                ax.set_title(f"{Method(result.method).label}\n{len(result.faces):,} faces{loose}", fontsize=9)
            if column == 0:
                ax.set_ylabel(name, fontsize=8)
    with Store(path.parent).writing(path.name) as file, file.open("wb") as stream:
        FigureCanvasAgg(figure).print_png(stream)


def _trimmed(images: Sequence[U8]) -> list[U8]:
    """Pictures of one size without the white above and below what is in any of them."""
    drawn = np.any([(image < 255).any(axis=(1, 2)) for image in images], axis=0)
    rows = np.flatnonzero(drawn)
    return [image[rows[0]: rows[-1] + 1] if len(rows) else image for image in images]


def _two_frames(vertices: F64, views: Views) -> tuple[int, int]:
    """The frame that sees most of a surface, and the one that does among those that look elsewhere from."""
    points = vertices[:: max(len(vertices) // _POINTS, 1)]
    height, width = views.size
    tried = np.unique(np.linspace(0, len(views) - 1, _TRIED).astype(int))
    seen = []
    for i in tried:
        x, y, z = views.R[i] @ points.T + views.T[i][:, None]
        u = views.K[i, 0, 0] * x + views.K[i, 0, 2] * z  # times z, so that nothing is divided by 0
        v = views.K[i, 1, 1] * y + views.K[i, 1, 2] * z
        seen.append(int(((z > 0) & (u >= 0) & (u < width * z) & (v >= 0) & (v < height * z)).sum()))
    first = int(np.argmax(seen))
    ahead = views.R[tried, 2]
    other = ahead @ ahead[first] < _APART
    if not other.any():
        other[np.argmin(ahead @ ahead[first])] = True
    second = int(np.argmax(np.where(other, seen, -1)))
    return int(tried[first]), int(tried[second])


def _camera(views: Views, frame: int) -> Views:
    """One camera, with a picture of about `_PIXELS` along its width."""
    height, width = views.size
    size = round(height * _PIXELS / width), _PIXELS
    return Views(np.zeros((1, *size), np.float32), resized(views.K[frame], views.size, size),
                 views.R[frame][None], views.T[frame][None])


def _from_the_side(results: Sequence[Reconstruction], views: Views, centres: F64) -> list[U8]:
    """Pictures from outside; up is what the cameras call up on average."""
    up = -views.R[:, 1].mean(axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    middle = results[0].vertices.mean(axis=0)
    towards = centres.mean(axis=0) - middle
    side = np.cross(up, towards)
    side /= max(float(np.linalg.norm(side)), 1e-9)
    turned = np.stack([np.cross(side, up), side, up])  # rows: the new x towards the cameras, y, and z up
    x, y, z = turned @ towards
    azimuth = float(np.rad2deg(np.arctan2(x, -y))) + _TURN
    elevation = float(np.clip(np.rad2deg(np.arctan2(z, np.hypot(x, y))), 15, 60))
    frame = np.concatenate([result.vertices for result in results]) @ turned.T
    return [shade(result.vertices @ turned.T, result.faces, _PIXELS, azimuth, elevation, frame=frame,
                  supersample=2) for result in results]
