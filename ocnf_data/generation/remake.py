"""What a stored sample was made of, made again: the mesh, the clean and the noisy views."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import fuse_tsdf
from ocnf_data.generation.inputs import Noise, observe
from ocnf_data.generation.procedural import is_procedural
from ocnf_data.generation.records import Item
from ocnf_data.generation.sample import read_item, render_item
from ocnf_data.generation.sequences import placed_frames
from ocnf_data.manifest import Manifest, Variant
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.meshes import Mesh, normalise
from ocnf_data.meshes.topology import mesh_stats
from ocnf_data.sequences.known import known_surface
from ocnf_data.views.cameras import Views
from ocnf_data.views.normalisation import Normalisation


@dataclass(frozen=True)
class Remade:
    """The intermediate results that a data set does not keep.

    Attributes:
        mesh: the mesh as it was read, in the file's coordinates; of a scan the measured part of the
            ground truth's surface at the finest resolution, in the scan's.
        vertices: (N, 3) float64 metres, normalised.
        views: all views of the rig, without noise, or all frames of the scan, in the cube.
        observed: the noisy views of each input variant, by its name.
    """

    mesh: Mesh
    vertices: F64
    views: Views
    observed: dict[str, Views]


def remake(
    manifest: Manifest, facts: Mapping[str, Any], meshes: str | os.PathLike[str] | None = None
) -> Remade:
    """Read, normalise, render and add noise as generation did for the sample with these facts.

    Args:
        manifest: the manifest of the data set.
        facts: the sample's `json` member.
        meshes: the folder of the meshes or scans; None for procedural shapes.

    Raises:
        OcnfError: the mesh or the scan is missing, or not the one that the sample was made of (`changed`).
    """
    if isinstance(manifest.source, SequenceSource):
        return _remake_frames(manifest, manifest.source, facts, meshes)
    item = _item(facts)
    mesh = read_item(manifest, item, meshes)
    if mesh.sha256 != item.sha256:
        raise OcnfError("not the mesh that the sample was made of", code="changed", where=item.source,
                        found=f"sha256 {mesh.sha256}", expected=item.sha256)
    vertices, _ = normalise(mesh, manifest.normalise.extent, manifest.normalise.padding)
    return _see(manifest, facts, mesh, vertices)


def remake_from_surface(manifest: Manifest, facts: Mapping[str, Any], vertices: F64, faces: I64) -> Remade:
    """What `remake` gives, with a surface in the place of a mesh that is not at hand.

    Args:
        manifest: of the data set.
        facts: the sample's `json` member.
        vertices: (N, 3) metres, normalised as the mesh was: of the sample's ground truth.
        faces: (M, 3).

    Raises:
        OcnfError: the sample is of a scan: its views are what was measured.
    """
    if isinstance(manifest.source, SequenceSource):
        raise _no_scans(facts)
    mesh = Mesh(vertices, faces, "", mesh_stats(vertices, faces))
    return _see(manifest, facts, mesh, vertices)


def _see(manifest: Manifest, facts: Mapping[str, Any], mesh: Mesh, vertices: F64) -> Remade:
    key = facts["key"]
    views = render_item(manifest, vertices, mesh, key=key)
    noise = Noise(manifest.seed, key, views.size)
    observed = {}
    for variant in manifest.inputs:
        indices = manifest.view_indices(variant)
        observed[variant.name] = observe(views.subset(indices), indices, variant, noise,
                                         _metres(facts, variant))
    return Remade(mesh, vertices, views, observed)


def _remake_frames(manifest: Manifest, source: SequenceSource, facts: Mapping[str, Any],
                   root: str | os.PathLike[str] | None) -> Remade:
    if root is None:
        raise _no_scans(facts)
    item = Item(facts["key"], facts["split"], facts["category"], facts["source"], facts["sha256"],
                int(facts["source"].rpartition(":")[2]))
    placement = facts["normalisation"]
    normalisation = Normalisation(np.array(placement["centre"]), placement["scale"])
    views = placed_frames(source, item, Path(root), normalisation)
    noise = Noise(manifest.seed, item.key, views.size)
    observed = {}
    for variant in manifest.inputs:
        indices = facts["inputs"][variant.name]["views"]
        observed[variant.name] = observe(views.subset(indices), indices, variant, noise,
                                         _metres(facts, variant))
    finest, extent = manifest.resolutions[-1], manifest.normalise.extent
    vertices, faces = known_surface(fuse_tsdf(views, finest, extent, manifest.truncation(finest)), extent)
    mesh = Mesh(normalisation.invert(vertices), faces, item.sha256 or "", mesh_stats(vertices, faces))
    return Remade(mesh, vertices, views, observed)


def _metres(facts: Mapping[str, Any], variant: Variant) -> float:
    """What the noise of an input was made with: samples of before may not say what `real_metres` would."""
    return float(facts["inputs"][variant.name].get("metres", variant.metres))


def _no_scans(facts: Mapping[str, Any]) -> OcnfError:
    return OcnfError("the frames of the scan are not at hand", code="missing", where=facts["source"],
                     fix="give the folder that the scans lie in as --meshes ROOT")


def _item(facts: Mapping[str, Any]) -> Item:
    source = facts["source"]
    index = int(source.rpartition(":")[2]) if is_procedural(source) else None
    return Item(facts["key"], facts["split"], facts["category"], source, facts["mesh"]["sha256"], index)
