"""One sample: mesh -> all views of the rig -> ground truth and inputs as octrees -> bytes.

A pure function of (manifest, item): nothing in here knows of other items, workers, order or time, but for the
`stages` that are told how long each step took.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError, printable
from ocnf_data.files.records import canonical_json
from ocnf_data.fusion import DepthPyramid
from ocnf_data.generation.fingerprint import view_fingerprint
from ocnf_data.generation.inputs import Noise, SampleOctrees, fuse_truth, noise_facts, real_metres
from ocnf_data.generation.procedural import make_procedural
from ocnf_data.generation.records import Item, Sample, Stages
from ocnf_data.generation.sequences import make_sequence_sample
from ocnf_data.manifest import Manifest
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.meshes import Mesh, Normalisation, normalise, read_mesh
from ocnf_data.render import render_depth
from ocnf_data.render.clearance import clearance
from ocnf_data.shards.tarformat import JSON, target_member
from ocnf_data.views.cameras import Views
from ocnf_data.views.rigs import look_from, rig_from_name
from ocnf_data.views.store import KeptViews, ViewStore
from ocnf_data.views.trajectories import path_around, path_inside

# Shares of the grid's extent: what is free around a path, and what somebody outside of things sees at least.
_MARGIN, _OPEN = 0.04, 0.2
_WITHIN = np.array([[0.12, 0.12, 0.4], [0.88, 0.88, 0.75]])  # of the mesh's box, in which a path inside stays


def maker(setup: dict[str, Any]) -> Callable[[Item, Stages], Sample]:
    """What a child process calls for each item; `setup` is a `ChildSetup` as plain values."""
    manifest = Manifest.from_dict(setup["manifest"])
    known, keep = (None if url is None else ViewStore(url) for url in (setup["views"], setup["keep_views"]))

    def make(item: Item, stages: Stages) -> Sample:
        return make_sample(manifest, item, setup["meshes"], known=known, keep=keep, stages=stages)

    return make


def make_sample(
    manifest: Manifest,
    item: Item,
    meshes: str | os.PathLike[str] | None = None,
    *,
    known: ViewStore | None = None,
    keep: ViewStore | None = None,
    stages: Stages | None = None,
) -> Sample:
    """The sample of an item: of a mesh, or of a scan (`generation.sequences`).

    Args:
        manifest: the manifest of the data set.
        item: the item to make.
        meshes: the folder that `item.source` is relative to; None for procedural shapes.
        known: store that may hold the mesh's views by this manifest's cameras; where it does not, they are
            rendered. Which of the two happens does not show in the sample.
        keep: store in which the views are kept for other runs.
        stages: records each stage and its time.

    Raises:
        OcnfError: the mesh cannot be used, with the code of `read_mesh`; `changed` where the file is not the
            one that was planned with; `invisible` where no view sees any of it.
    """
    stages = Stages() if stages is None else stages
    if isinstance(manifest.source, SequenceSource):
        return make_sequence_sample(manifest, manifest.source, item, meshes, keep, stages)
    with stages("read"):
        mesh = read_item(manifest, item, meshes)
    with stages("normalise"):
        vertices, normalisation = normalise(mesh, manifest.normalise.extent, manifest.normalise.padding)
    views = _see(manifest, item, mesh, vertices, normalisation, known, keep, stages)
    hit = np.isfinite(views.depth)
    if not hit.any():
        raise OcnfError("no camera sees any of the mesh", code="invisible", where=item.source)

    octrees = SampleOctrees(manifest, stages)
    with stages("pyramid"):
        pyramid = DepthPyramid(views)
    for resolution in manifest.resolutions:
        with stages("fuse target"):
            truth = fuse_truth(manifest, pyramid, resolution)
        octrees.add(target_member(resolution), truth, "target")
    noise = Noise(manifest.seed, item.key, views.size)
    for variant in manifest.inputs:
        indices = manifest.view_indices(variant)
        octrees.add_inputs(variant, views.subset(indices), indices, noise,
                           real_metres(variant, item.source, normalisation))
    facts = _sample_facts(manifest, item, mesh, normalisation, float(hit.mean()), octrees.leaf_counts)
    return Sample(item.key, {JSON: canonical_json(facts), **octrees.members}, stages.seconds)


def read_item(manifest: Manifest, item: Item, meshes: str | os.PathLike[str] | None) -> Mesh:
    """The mesh of an item, read or made; OcnfError where the file is not the one that was planned with."""
    if item.index is not None:
        return make_procedural(item.category, manifest.seed, item.index, item.split)
    if meshes is None:
        raise OcnfError("the folder of the meshes is not given", code="missing", where=item.source)
    if item.source != printable(item.source):
        raise OcnfError("the name is not UTF-8, so no sample can carry it", code="unreadable",
                        where=item.source, fix="rename the file, and generate into another folder")
    try:
        mesh = read_mesh(Path(meshes) / item.source, manifest.limits.max_bytes, manifest.limits.max_faces)
    except OcnfError as error:
        # Where the meshes lie is no part of the data set: its bytes name them as the manifest does.
        raise error.replaced(where=item.source) from error
    if item.sha256 is not None and mesh.sha256 != item.sha256:
        raise OcnfError("the file has changed since the plan was made", code="changed", where=item.source,
                        found=f"sha256 {mesh.sha256}", expected=item.sha256)
    return mesh


def _see(manifest: Manifest, item: Item, mesh: Mesh, vertices: F64, normalisation: Normalisation,
         known: ViewStore | None, keep: ViewStore | None, stages: Stages) -> Views:
    """The views: kept ones where there are any, else rendered; they are kept if asked for."""
    fingerprint = view_fingerprint(manifest)
    for store in (keep, known):
        if store is not None:
            with stages("load views"):
                views = _find(store, item.key, mesh.sha256, fingerprint)
            if views is not None:
                break
    else:
        store = None
        with stages("render"):
            views = render_item(manifest, vertices, mesh, key=item.key)
    if keep is not None and store is not keep:
        with stages("keep views"):
            keep.keep(item.key, KeptViews(views, mesh.sha256, fingerprint, normalisation,
                                          manifest.normalise.extent))
    return views


def _find(store: ViewStore, key: str, mesh_sha256: str, fingerprint: str) -> Views | None:
    """Kept views; a damaged file counts as none, because rendering gives the same."""
    try:
        return store.find(key, mesh_sha256, fingerprint)
    except OcnfError as error:
        if error.code != "damaged":
            raise
        return None


def render_item(manifest: Manifest, vertices: F64, mesh: Mesh, directions: F64 | None = None,
                key: str = "") -> Views:
    """Views without noise of normalised vertices (N, 3).

    From `directions` (V, 3) or all those of the rig; `key` is the item's, on which hand-held paths depend.
    """
    camera = manifest.camera
    R, T = _cameras(manifest, vertices, mesh, key) if directions is None else look_from(
        directions, camera.distance)
    depth = render_depth(vertices, mesh.faces, camera.K, R, T, camera.size, manifest.renderer,
                         manifest.normalise.near)
    return Views(depth, camera.K, R, T)


def _cameras(manifest: Manifest, vertices: F64, mesh: Mesh, key: str) -> tuple[F64, F64]:
    """R (V, 3, 3) and T (V, 3), world to camera."""
    camera = manifest.camera
    if camera.path is None:
        return look_from(rig_from_name(camera.rig), camera.distance)
    (kind, n), extent = camera.path, manifest.normalise.extent
    free = clearance(vertices, mesh.faces, _OPEN * extent, manifest.normalise.near)
    margin = _MARGIN * extent
    if kind == "around":
        return path_around(n, manifest.seed, key, (0.0, 0.0, 0.0), camera.distance, free, margin)
    used = vertices[np.unique(mesh.faces)]
    low, size = used.min(axis=0), np.ptp(used, axis=0)
    first, last = ((low + size * share).tolist() for share in _WITHIN)
    return path_inside(n, manifest.seed, key, first, last, free, margin)


def _sample_facts(manifest: Manifest, item: Item, mesh: Mesh, normalisation: Normalisation, coverage: float,
           leaf_counts: dict[str, int]) -> dict[str, Any]:
    """The sample's `json` member. Lengths are in metres, pixels where they say so."""
    camera = manifest.camera
    return {
        "key": item.key,
        "split": item.split,
        "category": item.category,
        "source": item.source,
        "mesh": {"sha256": mesh.sha256, **mesh.stats},
        "normalisation": {"centre": normalisation.centre.tolist(), "scale": normalisation.scale,
                          "extent": manifest.normalise.extent},
        "camera": {"rig": camera.rig, "views": camera.n_views, "K": camera.K.tolist(),
                   "size": list(camera.size), "distance": camera.distance, "renderer": manifest.renderer},
        "coverage": coverage,
        "seed": manifest.seed,
        "target": str(manifest.target),
        "truncation": {str(res): manifest.truncation(res) for res in manifest.resolutions},
        "inputs": {variant.name: {"views": list(manifest.view_indices(variant)),
                                  **noise_facts(variant, real_metres(variant, item.source, normalisation))}
                   for variant in manifest.inputs},
        "leaf_counts": leaf_counts,
    }
