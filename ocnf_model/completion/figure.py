"""Depth maps, their completions and the ground truth side by side."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import F32, F64, I64, U8, Bool
from ocnf_data.errors import missing_extra
from ocnf_data.render.shade import shade
from ocnf_model.completion.scores import Scores
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST, Visible

_WIDE, _HIGH, _PIXELS = 2.7, 2.05, 440  # inches of a picture, and pixels along a square one
_TRUTH = "ground truth"
_ASIDE = 75.0  # degrees around the vertical from the view, so that what it does not see is shown


@dataclass(frozen=True, eq=False)
class DrawnFrame:
    """A row of the figure.

    Attributes:
        scene: the frame.
        found: occupied voxels (D, H, W) by method.
        scores: figures by method, for the captions.
    """

    scene: Tabletop
    found: Mapping[str, Bool]
    scores: Mapping[str, Scores]


def draw_completions(pictures: Sequence[DrawnFrame]) -> bytes:
    """A PNG with a row a frame: the depth map, then the judged and occupied voxels by method, and in truth.

    Args:
        pictures: at least one; columns are the methods of the first.

    Raises:
        OcnfError: matplotlib or scikit-image is not installed (code `missing_extra`).
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("the figure needs matplotlib", "generate") from error
    methods = [*pictures[0].found, _TRUTH]
    figure = Figure(figsize=(_WIDE * (len(methods) + 1) + 0.4, (_HIGH + 0.2) * len(pictures) + 0.4), dpi=120,
                    layout="constrained")
    axes = figure.subplots(len(pictures), len(methods) + 1, squeeze=False)
    for row, picture in zip(axes, pictures, strict=True):
        scene = picture.scene
        row[0].imshow(_seen(scene.view.depth[0]), cmap="viridis_r", interpolation="nearest")
        row[0].set_xlabel(scene.name, fontsize=8)
        judged = Visible.of(scene.view, scene.shape, scene.voxel).judged
        _, height, width = (n * scene.voxel for n in scene.shape)
        frame = np.array([[0, 0, 0], [width, height, 0], [width, 0, 0.2], [0, height, 0.2]])
        for ax, name in zip(row[1:], methods, strict=True):
            volume = scene.occupied if name == _TRUTH else picture.found[name]
            vertices, faces = _surface(volume & judged, scene.voxel)
            drawn = shade(vertices, faces, size=_PIXELS, azimuth=_azimuth(scene) + _ASIDE, elevation=30,
                          frame=frame, supersample=2)
            ax.imshow(drawn[_PIXELS // 8: -_PIXELS // 8])
            if name in picture.scores:
                ax.set_xlabel(f"IoU {picture.scores[name].iou:.2f}", fontsize=8)
    for ax, title in zip(axes[0], ["depth map", *methods], strict=True):
        ax.set_title(title, fontsize=11)
    for ax in axes.flat:
        ax.set_xticks([])
        ax.set_yticks([])
        ax.spines[:].set_visible(False)
    png = io.BytesIO()
    FigureCanvasAgg(figure).print_png(png)
    return png.getvalue()


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
