"""A scan: posed depth, with colour where there is some."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import F32, F64, U8, as_numbers
from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import Views, resized, same_shape
from ocnf_data.views.scans.agreement import Agreement, agreement, judge
from ocnf_data.views.scans.images import read_colour
from ocnf_data.views.scans.listing import Axes, Direction, check_scale, convention
from ocnf_data.views.scans.poses import to_camera


@dataclass(frozen=True)
class Colour:
    """The colour images of a scan, read one at a time: together they can be larger than memory.

    Attributes:
        images: a file, or an array (H, W, 3) uint8, or None for a frame without, for each of the V frames.
        K: (V, 3, 3) intrinsics of the colour images, pixels; the pose is that of the frame's depth map.
    """

    images: Sequence[Path | U8 | None]
    K: F64

    def image(self, i: int) -> U8 | None:
        """(H, W, 3) uint8 red, green, blue of frame i; None where it has none."""
        image = self.images[i]
        return read_colour(image) if isinstance(image, Path) else image


@dataclass(frozen=True)
class Scan:
    """Posed depth of a scene.

    Attributes:
        views: depth in metres, 0 where there is no measurement.
        names: names of the V frames.
        cube: (centre (x, y, z), side) in metres of the space that the views were made for, where it is known.
        notes: what was left out or assumed, a sentence each.
        warnings: what looks wrong, with figures, a sentence each.
        colour: colour images, where the scan has them.
        format: the name of the format it was read from.
        agreement: how far neighbouring frames agree; None where this was not measured.
    """

    views: Views
    names: tuple[str, ...]
    cube: tuple[tuple[float, float, float], float] | None = None
    notes: tuple[str, ...] = ()
    colour: Colour | None = None
    format: str = "arrays"
    agreement: Agreement | None = None
    warnings: tuple[str, ...] = ()

    @classmethod
    def from_arrays(cls, depth: npt.ArrayLike, K: npt.ArrayLike, poses: npt.ArrayLike,
                    colour: npt.ArrayLike | None = None, *, depth_scale: float | None = None,
                    direction: Direction | str = Direction.CAMERA_TO_WORLD, axes: Axes | str = Axes.OPENCV,
                    names: Sequence[str] | None = None) -> Scan:
        """A scan of what is in memory.

        >>> depth, K = np.full((2, 4, 4), 1000, np.uint16), [[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]]
        >>> Scan.from_arrays(depth, K, [np.eye(4)] * 2, depth_scale=1000).views.depth[0, 0, 0]
        np.float32(1.0)

        Args:
            depth: (V, H, W) z of the camera, not the length of the ray. Floating point: metres, unless
                `depth_scale` says otherwise; 0 and NaN are no measurement, `inf` is a free ray. Integers:
                `depth_scale` is needed; 0 and 65535 are no measurement.
            K: (3, 3) or (V, 3, 3) intrinsics in pixels, pixel centres on integers.
            poses: (V, 4, 4), translation in metres.
            colour: (V, H', W', 3) uint8 red, green, blue: the same view in any size of the same shape.
            depth_scale: units in a metre.
            direction: `camera-to-world` or `world-to-camera`.
            axes: `opencv` (x right, y down, z forward) or `opengl` (y up, z backward) of the cameras.
            names: names of the V frames.

        Raises:
            OcnfError: shapes that do not fit, a pose that is not finite or not rigid (with the frame's name),
                integers without a scale, a scale that is not above 0, a convention of no such name.
        """
        where = "Scan.from_arrays"
        looks = convention(Axes, axes, where, "axes")
        turns = convention(Direction, direction, where, "direction")
        metres = _metres(as_numbers(depth, "Scan.from_arrays", "depth"), depth_scale)
        matrices = as_numbers(poses, "Scan.from_arrays", "poses", np.float64)
        n = len(metres)
        if matrices.shape != (n, 4, 4):
            raise OcnfError(f"the poses do not fit the {n} depth maps", where="Scan.from_arrays",
                            field="poses", found=matrices.shape, expected=(n, 4, 4))
        called = tuple(names) if names is not None else tuple(f"frame {i}" for i in range(n))
        if len(called) != n:
            raise OcnfError(f"the names do not fit the {n} depth maps", where="Scan.from_arrays",
                            field="names", found=len(called), expected=n)
        R, T = to_camera(matrices, [f"{where}: {name}" for name in called], turns, looks)
        views = Views(metres, as_numbers(K, "Scan.from_arrays", "K", np.float64), R, T)
        found = agreement(views, looks)
        return cls(views, called, colour=_colour(colour, views), agreement=found,
                   warnings=tuple(judge(found, views, where)))


def _metres(depth: npt.NDArray[Any], scale: float | None) -> F32:
    if depth.ndim != 3 or depth.size == 0 or depth.dtype.kind not in "fui":
        raise OcnfError("depth is not a stack of maps", where="Scan.from_arrays", field="depth",
                        found=f"{depth.dtype} {depth.shape}", expected="numbers (V, H, W)")
    whole = depth.dtype.kind in "ui"
    if scale is None and whole:
        raise OcnfError("whole numbers are in no known unit", where="Scan.from_arrays", field="depth_scale",
                        found=depth.dtype, expected="units in a metre, such as 1000 for millimetres")
    if scale is None:
        return to_metres(depth, 1.0)
    return to_metres(depth, 1 / check_scale(scale, "Scan.from_arrays", "depth_scale"))


def to_metres(stored: npt.NDArray[Any], unit: float) -> F32:
    """Depth in metres from stored numbers of `unit` metres; 0 where nothing was measured.

    Nothing was measured at 0, at 65535 of whole numbers, and at NaN of floating-point ones.
    """
    metres = (stored * np.float32(unit)).astype(np.float32, copy=False)
    metres[stored == 65535 if stored.dtype.kind in "ui" else np.isnan(metres)] = 0
    return metres


def _colour(colour: npt.ArrayLike | None, views: Views) -> Colour | None:
    if colour is None:
        return None
    images = as_numbers(colour, "Scan.from_arrays", "colour")
    if images.ndim != 4 or images.shape[0] != len(views) or images.shape[3] != 3 or images.dtype != np.uint8:
        raise OcnfError("colour does not fit the depth", where="Scan.from_arrays", field="colour",
                        found=f"{images.dtype} {images.shape}", expected=f"uint8 ({len(views)}, H, W, 3)")
    if not same_shape(views.size, (images.shape[1], images.shape[2])):
        raise OcnfError("the colour images are not the depth maps scaled", where="Scan.from_arrays",
                        field="colour", found=f"{images.shape[2]}x{images.shape[1]}",
                        expected="the shape of {1}x{0}".format(*views.size))
    return Colour(list(images), resized(views.K, views.size, (images.shape[1], images.shape[2])))
