"""The paper's qualitative figure: rows of resolutions, columns of methods and the ground truth."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping

import numpy as np

from ocnf_data.errors import missing_extra
from ocnf_data.render.shade import shade
from ocnf_model.evaluation.measure import TRUTH, MeshArrays, Row

_INCHES = 2.6
_PIXELS = 420


def caption(row: Row) -> str:
    """What stands below a reconstruction: its error where views have looked and where not, and its surface's.

    `thin` is the recall of what is thinner than 1.5 voxels. What is not known is left out.
    """
    surface, regions = row.surface, row.regions
    seen = regions.seen_free + regions.seen_band + regions.seen_inside
    unseen = regions.unseen_free + regions.unseen_band + regions.unseen_inside
    lines = (
        ((row.mad_mm, f"MAD {row.mad_mm:.2f} mm"), (seen, f"seen {seen:.2f}"),
         (unseen, f"unseen {unseen:.2f}")),
        ((surface.f_score, f"F {surface.f_score:.2f}"),
         (surface.chamfer_voxels, f"Chamfer {surface.chamfer_voxels:.2f} voxels")),
        ((surface.normal_consistency, f"normals {surface.normal_consistency:.2f}"),
         (surface.recall_thin, f"thin {surface.recall_thin:.2f}")))
    texts = (", ".join(text for value, text in line if not math.isnan(value)) for line in lines)
    return "\n".join(text for text in texts if text)


def draw_surfaces(surfaces: Mapping[tuple[int, str], MeshArrays], title: str, up: str = "z",
                  captions: Mapping[tuple[int, str], str] | None = None) -> bytes:
    """A PNG of one model's surfaces.

    Args:
        surfaces: vertices (N, 3) and faces (M, 3) of each surface by (resolution, method), columns in the
            order in which they are met; `TRUTH` comes last. What is missing leaves its place empty.
        title: title of the figure.
        up: the axis that points up, y or z.
        captions: what stands below each surface, by (resolution, method); None for none.

    Raises:
        OcnfError: matplotlib is not installed (`missing_extra`).
        KeyError: the ground truth of the finest resolution, which frames all pictures, is missing.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("the figure needs matplotlib", "generate") from error
    resolutions = sorted({resolution for resolution, _ in surfaces})
    methods = sorted(dict.fromkeys(method for _, method in surfaces), key=lambda method: method == TRUTH)
    frame = surfaces[resolutions[-1], TRUTH][0]
    if not len(frame):
        frame = np.array([[-1.5] * 3, [1.5] * 3])
    figure = Figure(figsize=(_INCHES * len(methods) + 0.4, (_INCHES + 0.35) * len(resolutions) + 0.6),
                    dpi=150, layout="constrained")
    axes = figure.subplots(len(resolutions), len(methods), squeeze=False)
    for row, resolution in enumerate(resolutions):
        for column, method in enumerate(methods):
            ax = axes[row, column]
            if (resolution, method) in surfaces:
                ax.imshow(shade(*surfaces[resolution, method], size=_PIXELS, up=up, frame=frame,
                                supersample=2),
                          interpolation="lanczos")
            ax.set_xticks([])
            ax.set_yticks([])
            ax.spines[:].set_visible(False)
            if row == 0:
                ax.set_title(method, fontsize=11)
            ax.set_xlabel((captions or {}).get((resolution, method), ""), fontsize=7, labelpad=2)
            if column == 0:
                ax.set_ylabel(f"{resolution}³", fontsize=11)
    figure.suptitle(title, fontsize=11)
    picture = io.BytesIO()
    FigureCanvasAgg(figure).print_png(picture)
    return picture.getvalue()
