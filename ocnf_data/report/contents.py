"""What a sample has on the page: surfaces, points, depth maps and slices, gathered one by one and packed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import U8
from ocnf_data.encodings import Encoding
from ocnf_data.errors import missing_extra
from ocnf_data.octree import GridOctree
from ocnf_data.render.pictures import AXES, as_distance, depth_colours, signed, slice_cells
from ocnf_data.report.blob import pack
from ocnf_data.report.deviation import Deviation
from ocnf_data.report.geometry import Triangles, as_bytes, as_steps, drawn_on, ordered, seen_points, simplify
from ocnf_data.views.cameras import Views

ERROR_COLOURS = ("#ece9e2", "#f4d98f", "#ec9a4c", "#c63f33", "#5d1230")
"""From no error to the end of the scale, at equal distances."""
_POINTS = 12_000
_DRAWN = 20_000  # points that a mean error is measured at
_DEPTH_WIDTH = 240  # pixels
_WEBP = 82  # quality of pictures


class Scale(NamedTuple):
    """What positions and colours of a page are relative to.

    Attributes:
        extent: side of the cube, metres.
        voxel: side of a voxel of what is shown, metres.
        error: the error at the end of the colour scale, metres.
        triangles: the most of a surface.
    """

    extent: float
    voxel: float
    error: float
    triangles: int


class Card(NamedTuple):
    """A sample in the gallery.

    Attributes:
        key, split, category, source: the sample's.
        values: one for each column of the page; None where it is not known.
        thumbnail: a picture, WebP.
        blob: what the 3-D view gets, as `blob.pack` packs it.
    """

    key: str
    split: str
    category: str
    source: str
    values: list[float | None]
    thumbnail: bytes
    blob: str


@dataclass
class Contents:
    """Gathers what there is to see of a sample.

    Attributes:
        scale: of the page.
        reference: distances to the ground truth; None: errors are not shown.
    """

    scale: Scale
    reference: Deviation | None = None
    _arrays: dict[str, npt.NDArray[Any]] = field(default_factory=dict)
    _shown: list[dict[str, Any]] = field(default_factory=list)
    _depths: list[dict[str, Any]] = field(default_factory=list)
    _slices: list[dict[str, Any]] = field(default_factory=list)

    def surface(self, name: str, surface: Triangles, caption: str = "", *, flat: bool = False,
                compare: bool = True) -> float | None:
        """Add a surface, made of fewer triangles where it has too many; its mean error in millimetres.

        Args:
            name: what its button says.
            surface: in metres.
            caption: a line below the name.
            flat: shade it by its triangles, not smoothly: for meshes made by hand.
            compare: whether its distance to the reference is its colour.

        Returns:
            the mean over points drawn evenly on the surface as it was before; None where nothing is compared.
        """
        kept = ordered(simplify(surface, self.scale.triangles))
        at = f"surface{len(self._shown)}"
        small = len(kept.vertices) <= 65536
        self._arrays[f"{at}/positions"] = as_steps(kept.vertices, self.scale.extent)
        self._arrays[f"{at}/faces"] = kept.faces.astype(np.uint16 if small else np.uint32)
        mean = None
        if compare and self.reference is not None and len(kept.vertices):
            error = self.reference(kept.vertices)
            if np.isfinite(error).all():
                self._arrays[f"{at}/error"] = as_bytes(error, self.scale.error)
                mean = 1000 * float(self.reference(drawn_on(surface, _DRAWN)).mean())
        self._shown.append({"name": name, "kind": "surface", "caption": caption, "flat": flat,
                            "triangles": len(kept.faces), "of": len(surface.faces), "mean": mean,
                            "hasError": mean is not None})
        return mean

    def points(self, name: str, views: Views, caption: str = "") -> None:
        """Add the measured points of some views; their distance to the reference is their colour.

        Those beyond the cube, as frames of a scan have them, are left out.
        """
        points = seen_points(views, _POINTS)
        points = points[(np.abs(points) <= self.scale.extent / 2).all(axis=1)]
        cell = np.floor((points / self.scale.extent + 0.5) * 48).astype(np.int64)
        points = points[np.lexsort((points[:, 2], cell[:, 0], cell[:, 1], cell[:, 2]))]
        at = f"surface{len(self._shown)}"
        self._arrays[f"{at}/positions"] = as_steps(points, self.scale.extent)
        mean = None
        if self.reference is not None and len(points):
            error = self.reference(points)
            if np.isfinite(error).all():
                self._arrays[f"{at}/error"] = as_bytes(error, self.scale.error)
                mean = 1000 * float(error.mean())
        measured = int((np.isfinite(views.depth) & (views.depth > 0)).sum())
        self._shown.append({"name": name, "kind": "points", "caption": caption, "triangles": len(points),
                            "of": measured, "mean": mean, "hasError": mean is not None})

    def depth(self, title: str, depth: npt.NDArray[np.float32], limits: tuple[float, float]) -> None:
        """Add a depth map (H, W), metres; `limits` are the ends of its colours."""
        picture = (255 * depth_colours(depth, limits)[..., :3] + 0.5).astype(np.uint8)
        self._arrays[f"depth{len(self._depths)}"] = np.frombuffer(as_webp(picture, _DEPTH_WIDTH), np.uint8)
        self._depths.append({"title": title, "limits": limits})

    def slice(self, name: str, title: str, octree: GridOctree, axis: int, index: int,
              encoding: Encoding) -> None:
        """Add the plane `index` across `axis` (0 z, 1 y, 2 x) of an octree, with its cells."""
        rows, squares = slice_cells(octree, axis, index)
        order = np.lexsort((squares[:, 1], squares[:, 0]))
        at = f"slice{len(self._slices)}"
        self._arrays[f"{at}/squares"] = squares[order].astype(np.uint16)
        value = np.clip(as_distance(octree.data[rows], encoding), -1, 1)[order]
        self._arrays[f"{at}/values"] = np.rint((value + 1) * 127.5).astype(np.uint8)
        height, width = (n for a, n in enumerate(octree.shape) if a != axis)
        up, right = (name for name in AXES if name != AXES[axis])
        self._slices.append({"name": name, "title": title, "height": height, "width": width, "up": up,
                             "right": right, "cells": len(rows)})

    def pack(self, more: Mapping[str, Any] | None = None) -> str:
        """Everything as one string; `more` goes along as it is."""
        meta = {"shown": self._shown, "depths": self._depths, "slices": self._slices, **(more or {})}
        return pack(self._arrays, meta)


def signed_surface(octree: GridOctree, encoding: Encoding, extent: float,
                   known: GridOctree | None = None) -> Triangles:
    """The surface of an octree of any encoding: where the number that stands for its distance is 0.

    With `known`, a TSDF / tau, the part of it between voxels that `known` has a measurement of.
    """
    from ocnf_data.octree.surface import octree_surface
    from ocnf_data.sequences.known import known_surface

    distance = signed(octree, encoding)
    return Triangles(*(octree_surface(distance, extent) if known is None else
                       known_surface(distance, extent, known)))


def as_webp(picture: U8, width: int | None = None) -> bytes:
    """A picture (H, W, 3), RGB, as WebP; not wider than `width` pixels.

    Raises:
        OcnfError: `missing_extra` without OpenCV.
    """
    try:
        import cv2
    except ImportError as error:
        raise missing_extra("the page's pictures need OpenCV", "generate") from error
    if width is not None and picture.shape[1] > width:
        height = max(1, round(picture.shape[0] * width / picture.shape[1]))
        picture = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    written, data = cv2.imencode(".webp", np.ascontiguousarray(picture[..., ::-1]),
                                 [cv2.IMWRITE_WEBP_QUALITY, _WEBP])
    if not written:
        raise RuntimeError("OpenCV did not encode a picture")
    return data.tobytes()
