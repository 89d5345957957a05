"""A frame's depth map, its completions and its ground truth side by side."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np

from ocnf_data.arrays import F32, F64, I64, U8, Bool
from ocnf_data.errors import missing_extra
from ocnf_data.render.shade import shade
from ocnf_model.completion.scores import Scores
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST, Visible

_INCHES, _PIXELS = 2.6, 420
_ASIDE = 75.0  # degrees around the vertical from the view, so that what it does not see is shown


def draw_completions(scene: Tabletop, found: Mapping[str, Bool], scores: Mapping[str, Scores]) -> bytes:
    """A PNG: the depth map, then the voxels that are judged and occupied, by method, and in truth.

    Args:
        scene: the frame.
        found: occupied voxels (D, H, W) by method, columns in this order.
        scores: figures by method, for the captions.

    Raises:
        OcnfError: matplotlib or scikit-image is not installed (code `missing_extra`).
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("the figure needs matplotlib", "generate") from error
    judged = Visible.of(scene.view, scene.shape, scene.voxel).judged
    volumes = {**found, "ground truth": scene.occupied}
    figure = Figure(figsize=(_INCHES * (len(volumes) + 1) + 0.8, _INCHES + 0.7), dpi=120,
                    layout="constrained")
    axes = figure.subplots(1, len(volumes) + 1, width_ratios=[4 / 3, *[1] * len(volumes)])
    axes[0].imshow(_seen(scene.view.depth[0]), cmap="viridis_r", interpolation="nearest")
    axes[0].set_title("depth map", fontsize=11)
    height, width = scene.shape[1] * scene.voxel, scene.shape[2] * scene.voxel
    frame = np.array([[0, 0, 0], [width, height, 0.3]])
    for ax, (name, volume) in zip(axes[1:], volumes.items(), strict=True):
        vertices, faces = _surface(volume & judged, scene.voxel)
        ax.imshow(shade(vertices, faces, size=_PIXELS, azimuth=_azimuth(scene) + _ASIDE, elevation=30,
                        frame=frame, supersample=2))
        ax.set_title(name, fontsize=11)
        if name in scores:
            ax.set_xlabel(f"IoU {scores[name].iou:.2f}", fontsize=9)
    for ax in axes:
        ax.set_xticks([])
        ax.set_yticks([])
        ax.spines[:].set_visible(False)
    figure.suptitle(scene.name, fontsize=10)
    picture = io.BytesIO()
    FigureCanvasAgg(figure).print_png(picture)
    return picture.getvalue()


def _seen(depth: F32) -> F32:
    """Metres; NaN, which is left white, where nothing is measured or nothing met."""
    return np.where((depth > 0) & np.isfinite(depth), depth, np.nan).astype(np.float32)


def _surface(occupied: Bool, voxel: float) -> tuple[F64, I64]:
    """Vertices in metres and faces around occupied voxels, over a slab where the table is."""
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise missing_extra("the figure needs scikit-image", "fuse") from error
    solid: U8 = np.pad(occupied, 1).astype(np.uint8)
    solid[LOWEST: LOWEST + 1, 1:-1, 1:-1] = 1
    vertices, faces, _, _ = marching_cubes(solid.astype(np.float32), 0.5)
    return (vertices[:, ::-1] - 0.5) * voxel, faces.astype(np.int64)


def _azimuth(scene: Tabletop) -> float:
    """Degrees around the vertical of the camera's place, as `shade` counts them."""
    x, y, _ = -scene.view.R[0].T @ scene.view.T[0]
    middle = np.array(scene.shape[::-1]) * scene.voxel / 2
    return float(np.degrees(np.arctan2(x - middle[0], middle[1] - y)))
