"""What a stored sample was made of, made again: the mesh, the clean and the noisy views."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError
from ocnf_data.generation.procedural import is_procedural
from ocnf_data.generation.records import Item
from ocnf_data.generation.sample import Noise, observe, read_item, render_item
from ocnf_data.manifest import Manifest
from ocnf_data.meshes import Mesh, normalise
from ocnf_data.meshes.topology import mesh_stats
from ocnf_data.views.cameras import Views


@dataclass(frozen=True)
class Remade:
    """The intermediate results that a data set does not keep.

    Attributes:
        mesh: the mesh as it was read, in the file's coordinates.
        vertices: (N, 3) float64 metres, normalised.
        views: all views of the rig, without noise.
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
        meshes: the folder of the meshes; None for procedural shapes.

    Raises:
        OcnfError: the mesh is missing, or not the one that the sample was made of (`changed`).
    """
    item = _item(facts)
    mesh = read_item(manifest, item, meshes)
    if mesh.sha256 != item.sha256:
        raise OcnfError("not the mesh that the sample was made of", code="changed", where=item.source,
                        found=f"sha256 {mesh.sha256}", expected=item.sha256)
    vertices, _ = normalise(mesh, manifest.normalise.extent, manifest.normalise.padding)
    return _see(manifest, item.key, mesh, vertices)


def remake_from_surface(manifest: Manifest, facts: Mapping[str, Any], vertices: F64, faces: I64) -> Remade:
    """What `remake` gives, with a surface in the place of a mesh that is not at hand.

    Args:
        manifest: of the data set.
        facts: the sample's `json` member.
        vertices: (N, 3) metres, normalised as the mesh was: of the sample's ground truth.
        faces: (M, 3).
    """
    mesh = Mesh(vertices, faces, "", mesh_stats(vertices, faces))
    return _see(manifest, facts["key"], mesh, vertices)


def _see(manifest: Manifest, key: str, mesh: Mesh, vertices: F64) -> Remade:
    views = render_item(manifest, vertices, mesh, key=key)
    noise = Noise(manifest.seed, key, views.size)
    observed = {variant.name: observe(manifest, views, variant, noise) for variant in manifest.inputs}
    return Remade(mesh, vertices, views, observed)


def _item(facts: Mapping[str, Any]) -> Item:
    source = facts["source"]
    index = int(source.rpartition(":")[2]) if is_procedural(source) else None
    return Item(facts["key"], facts["split"], facts["category"], source, facts["mesh"]["sha256"], index)
