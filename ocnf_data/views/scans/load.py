"""Make a scan of a listing: choose frames, check poses, decode depth, look whether the frames agree."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from ocnf_data.arrays import F32, F64
from ocnf_data.errors import OcnfError
from ocnf_data.files.memory import usable_memory
from ocnf_data.views.cameras import Views, resized, same_shape
from ocnf_data.views.rigs import intrinsics as pinhole
from ocnf_data.views.scans.agreement import agreement, judge
from ocnf_data.views.scans.images import image_size, read_depth
from ocnf_data.views.scans.listing import Frame, Listing, Said, check_pinhole, left_out
from ocnf_data.views.scans.poses import to_camera
from ocnf_data.views.scans.scan import Colour, Scan, to_metres
from ocnf_data.views.scans.selection import choose
from ocnf_data.views.scans.vertex_colour import colour_notes

_MAX_FRAMES = 20_000
_THREADS = 8  # decoding lets go of the interpreter's lock
_SHARE = 1 / 3  # of the memory for depth as float32: its pyramid takes as much again, a copy too


def load(listing: Listing, where: object, format_name: str, frames: str | int | None = None, every: int = 1,
         said: Said | None = None, report: Callable[[int, int], None] | None = None,
         colour: bool = True) -> Scan:
    """The scan.

    Frames whose pose is not finite (the tracking was lost) are left out, by name, before frames are chosen.

    Args:
        listing: all frames of the scan.
        where: the scan, for messages.
        format_name: recorded in the scan.
        frames: how many, or which range (see `choose`).
        every: take every n-th of these only.
        said: what the user says in place of the format's definition.
        report: told (frames read, frames in all) after each frame.
        colour: whether the colour images are looked for.

    Raises:
        OcnfError: no frame that can be used, a pose that is not rigid, a depth map that is damaged or of
            another size, no intrinsics, translations in millimetres.
    """
    said = said or Said()
    listing = posed(listing, where)
    chosen = [listing.frames[i] for i in choose(len(listing.frames), frames, every)]
    K = _intrinsics(chosen, listing, said, where)
    poses = np.stack([frame.pose for frame in chosen])
    names = [f"{frame.where}" if frame.name in frame.where.name else f"{frame.where}: {frame.name}"
             for frame in chosen]
    axes = said.axes or listing.axes
    R, T = to_camera(poses, names, said.direction or listing.direction, axes, said.pose_scale)
    unit = listing.unit if said.depth_scale is None else 1 / said.depth_scale
    depth = _crop(_read_depths(chosen, unit, where, report), said.crop, where)
    views = Views(depth, K, R, T)
    found = agreement(views, axes)
    warnings = tuple(judge(found, views, where))
    coloured, lacking = _colour(chosen, views, listing.colour) if colour else (None, [])
    return Scan(views, tuple(frame.name for frame in chosen), listing.cube, (*listing.notes, *lacking),
                coloured, format_name, found, warnings)


def posed(listing: Listing, where: object) -> Listing:
    """The frames whose pose is finite, with a note on the others.

    Raises:
        OcnfError: there are none (`empty`).
    """
    lost = [not np.isfinite(frame.pose).all() for frame in listing.frames]
    found = tuple(frame for frame, gone in zip(listing.frames, lost, strict=True) if not gone)
    names = [frame.name for frame in listing.frames]
    notes = (*listing.notes, *left_out("frame", "whose pose is not known (NaN or infinite)", names, lost))
    if not found:
        raise OcnfError("no frame can be used", code="empty", where=where, found="; ".join(notes) or None)
    return replace(listing, frames=found, notes=notes)


def _intrinsics(frames: Sequence[Frame], listing: Listing, said: Said, where: object) -> F64:
    """Intrinsics (V, 3, 3) of the depth maps, in pixels."""
    if said.intrinsics is not None:
        return np.tile(pinhole(*said.intrinsics), (len(frames), 1, 1))
    matrices = []
    for frame in frames:
        if frame.K is None:
            raise OcnfError("the scan does not say its intrinsics", code="missing", where=where,
                            field="intrinsics", fix=listing.intrinsics)
        matrices.append(check_pinhole(frame.K, where))
    return np.stack(matrices)


def _read_depths(frames: Sequence[Frame], unit: float, where: object,
                 report: Callable[[int, int], None] | None) -> F32:
    """(V, H, W) float32 metres, 0 where nothing was measured."""
    height, width = image_size(frames[0].depth)
    memory = usable_memory()
    most = min(_MAX_FRAMES, int(_SHARE * memory) // (height * width * 4))
    if len(frames) > most:
        raise OcnfError("too many frames to hold in memory", code="too_large", where=where, field="frames",
                        found=f"{len(frames)} of {width}x{height}",
                        expected=f"at most {most} with the {memory / 1e9:,.1f} GB that may be used",
                        fix=f"take {most} frames (--frames {most})" if most else None)
    depth = np.empty((len(frames), height, width), np.float32)

    def read(i: int) -> None:
        stored = read_depth(frames[i].depth)
        if stored.shape != (height, width):
            raise OcnfError("frames differ in size", where=frames[i].depth, found=stored.shape,
                            expected=(height, width))
        depth[i] = to_metres(stored, unit)
        depth[i][np.isposinf(depth[i])] = 0  # an NPY's: whoever wrote it has measured nothing there
        if not (depth[i] >= 0).all():
            raise OcnfError("depth is negative", where=frames[i].depth, found=float(depth[i].min()))

    with ThreadPoolExecutor(min(os.cpu_count() or 1, _THREADS)) as pool:
        for done, _ in enumerate(pool.map(read, range(len(frames))), 1):
            if report is not None:
                report(done, len(frames))
    return depth


def _crop(depth: F32, crop: tuple[int, int, int, int], where: object) -> F32:
    """Take what was measured along the borders for not measured; the intrinsics stay as they are."""
    left, top, right, bottom = crop
    height, width = depth.shape[1:]
    if left + right >= width or top + bottom >= height:
        raise OcnfError("the crop leaves nothing", where=where, field="crop", found=crop,
                        expected=f"less than {width}x{height} pixels")
    inner = np.zeros((height, width), bool)
    inner[top : height - bottom, left : width - right] = True
    depth[:, ~inner] = 0
    return depth


def _colour(frames: Sequence[Frame], views: Views, known: str | None) -> tuple[Colour | None, list[str]]:
    """The colour images, and notes: what is known of them, and which the scan names but cannot be used."""
    images: list[Path | None] = []
    matrices, faults = [], []
    for frame, K in zip(frames, views.K, strict=True):
        image, own = frame.colour, frame.K_colour
        if image is not None:
            try:
                size = image_size(image)
                if own is None and not same_shape(views.size, size):
                    raise OcnfError("the colour image is not the depth map scaled", where=image,
                                    found="{1}x{0}".format(*size), expected="{1}x{0}".format(*views.size))
                own = resized(K, views.size, size) if own is None else own
            except OcnfError as error:
                faults.append(error)
                image = None
        images.append(image)
        matrices.append(K if own is None else own)
    notes = colour_notes(faults, len(frames))
    if not any(images):
        return None, notes
    return Colour(images, np.stack(matrices)), notes if known is None else [known, *notes]
