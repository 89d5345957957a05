"""A picture of a sample: the mesh, what its cameras see, and the octrees of input and ground truth."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.generation.remake import Remade, remake, remake_from_surface
from ocnf_data.inspection.pictures import save_picture
from ocnf_data.manifest import Manifest, Variant
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_data.render.pictures import (
    Window,
    busiest_plane,
    busiest_window,
    depth_limits,
    draw_depth,
    draw_slice,
    signed,
)
from ocnf_data.render.shade import best_azimuth, shade
from ocnf_data.sequences.known import known_surface
from ocnf_data.shards.browse import StoredSample
from ocnf_data.shards.tarformat import input_member, target_member

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ACROSS: Final = 4
_AXIS: Final = 1  # slices are planes of equal y
_TRUTH_COLOUR = (0.62, 0.72, 0.82)


def draw_sample(
    sample: StoredSample,
    manifest: Manifest,
    path: Path,
    meshes: Path | None = None,
    variant: str | None = None,
    encoding: Encoding | None = None,
    up: str = "z",
) -> None:
    """Draw one sample to `path`: every view of an input variant, and its octrees beside the ground truth's.

    Where the meshes are not at hand, the ground truth's surface stands in for the mesh, and the picture says
    so.

    Args:
        sample: which.
        manifest: of its data set.
        path: of the PNG.
        meshes: the folder of the meshes; None: where the manifest says, if that is there.
        variant: which input; None: the first.
        encoding: None: the variant's first.
        up: which axis of the meshes points up, `y` or `z`.

    Raises:
        OcnfError: no such variant or encoding; `meshes` is given, and the mesh is not there or has changed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("the picture needs matplotlib", "generate") from error

    chosen = _variant(manifest, variant)
    encoding = encoding or chosen.encodings[0]
    if encoding not in chosen.encodings:
        raise OcnfError("the input is not stored like that", field="encoding", found=encoding,
                        expected=", ".join(chosen.encodings))
    coarse, fine = manifest.resolutions[0], manifest.resolutions[-1]
    used = [coarse, fine] if fine > coarse else [fine]
    inputs = {res: sample.octree(input_member(chosen.name, encoding, res)) for res in used}
    targets = {res: sample.octree(target_member(res)) for res in used}
    surface = _surface(manifest, targets[fine])
    remade, missing = _remade(sample, manifest, meshes, surface)

    noisy = remade.observed[chosen.name].depth
    rows = 2 + -(-len(noisy) // _ACROSS)
    figure = Figure(figsize=(4 * _ACROSS, 4.1 * rows), layout="constrained")
    axes = figure.subplots(rows, _ACROSS)
    for ax in axes.flat:
        ax.set_axis_off()
    azimuth = best_azimuth(remade.vertices, remade.mesh.faces, up)
    _picture(axes[0, 0], shade(remade.vertices, remade.mesh.faces, 640, azimuth, up=up),
             missing or f"{_what(manifest)}, {len(remade.mesh.faces):,} faces")
    _picture(axes[0, 1], shade(*surface, 640, azimuth, up=up, frame=remade.vertices, colour=_TRUTH_COLOUR),
             f"ground-truth surface, {fine}³")
    limits = _draw_views(axes[0, 2], list(axes[1:-1].flat), remade, chosen,
                         sample.facts["inputs"][chosen.name])

    plane = busiest_plane(targets[coarse], _AXIS)
    truth_kind = Encoding.OCCUPANCY if manifest.target == "occupancy" else Encoding.TSDF
    places = iter(axes[-1])
    cropped = ""
    for res in used:
        at = plane * res // coarse
        window = busiest_window(targets[res], _AXIS, at, 2 * coarse) if res > 2 * coarse else None
        cropped += _crop_text(window, res)
        for octree, kind, what in ((inputs[res], encoding, f"input, {encoding}"),
                                   (targets[res], truth_kind, "ground truth")):
            ax = next(places)
            ax.set_axis_on()
            draw_slice(ax, octree, _AXIS, at, kind, window)
            shown = f"\ncropped: {window.width} of {res} voxels across" if window else ""
            ax.set_title(f"{what}, {res}³, y = {at}\n{_leaves(octree)}{shown}", fontsize=10)
    facts = sample.facts
    lines = [f"split {sample.split}, category {facts['category']}", f"source {facts['source']}", "",
             f"depth: {limits[0]:.2f} to {limits[1]:.2f} m; white is a free ray, red no measurement", "",
             "slices: blue is free, white the surface, red inside or unseen; lines are the octree's cells",
             cropped]
    axes[0, 3].text(0, 0.95, "\n".join(textwrap.fill(line, 44) for line in lines), va="top", fontsize=11,
                    transform=axes[0, 3].transAxes)
    figure.suptitle(sample.key, fontsize=13)
    save_picture(figure, path)


def _variant(manifest: Manifest, name: str | None) -> Variant:
    chosen = next((v for v in manifest.inputs if name in (None, v.name)), None)
    if chosen is None:
        raise OcnfError("the data set has no such input", field="variant", found=name,
                        expected=", ".join(v.name for v in manifest.inputs))
    return chosen


def _remade(sample: StoredSample, manifest: Manifest, meshes: Path | None,
            surface: tuple[Any, Any]) -> tuple[Remade, str]:
    """The mesh and its views, or what stands in for them and a title that says so."""
    try:
        return remake(manifest, sample.facts, manifest.meshes_root(meshes)), ""
    except OcnfError:
        if meshes is not None or isinstance(manifest.source, SequenceSource):
            raise
        return (remake_from_surface(manifest, sample.facts, *surface),
                "ground-truth surface in place of the mesh,\nof which the depth is too (give --meshes DIR)")


def _surface(manifest: Manifest, truth: GridOctree) -> tuple[F64, I64]:
    """Of a scan without the walls around what no frame has seen, which would hide it."""
    extent = manifest.normalise.extent
    if manifest.target == "occupancy":
        return octree_surface(signed(truth, Encoding.OCCUPANCY), extent)
    if isinstance(manifest.source, SequenceSource):
        return known_surface(truth, extent)
    return octree_surface(truth, extent)


def _what(manifest: Manifest) -> str:
    return "surface of all frames" if isinstance(manifest.source, SequenceSource) else "mesh"


def _picture(ax: Axes, image: Any, title: str) -> None:
    ax.imshow(image)
    ax.set_title(title, fontsize=10)


def _draw_views(first: Axes, others: list[Axes], remade: Remade, variant: Variant,
                facts: Mapping[str, Any]) -> tuple[float, float]:
    """The first view without noise, then every view as the input has it; the range of the colours, metres.

    `facts` are the sample's of the input: its views, and of scans their frames' names.
    """
    indices = facts["views"]
    clean, noisy = remade.views.depth, remade.observed[variant.name].depth
    limits = depth_limits(clean[list(indices)])
    noise = variant.noise_in_words
    titles = [f"depth without noise, view {indices[0]}", *(f"input view {i}, {noise}" for i in indices)]
    if "frames" in facts:
        titles = [f"depth of {facts['frames'][0]}", *(f"input, {name}" for name in facts["frames"])]
    for ax, depth, title in zip([first, *others], [clean[indices[0]], *noisy], titles, strict=False):
        ax.set_axis_on()
        draw_depth(ax, depth, limits)
        ax.set_title(title, fontsize=10)
    return limits


def _crop_text(window: Window | None, resolution: int) -> str:
    if window is None:
        return ""
    return (f"slices at {resolution}³ show a part only: {window.width} of {resolution} voxels, from column "
            f"{window.column:.0f} and row {window.row:.0f} on")


def _leaves(octree: GridOctree) -> str:
    return f"{octree.n_leaves:,} leaves, {octree.n_leaves / np.prod(octree.shape):.1%} of the voxels"
