"""Make octrees of a body and a look, by generation's own functions, rounded as shards store them.

So a sample with the rotation, views and noise of a generated one is equal to it bit for bit.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid
from ocnf_data.generation.inputs import fuse_input, fuse_truth
from ocnf_data.generation.sample import read_item, render_item
from ocnf_data.manifest import Manifest
from ocnf_data.manifest.synthesis import Synthesis
from ocnf_data.meshes import Mesh, normalise
from ocnf_data.octree.stored import TARGET, RawOctree, quantise
from ocnf_data.render import render_depth
from ocnf_data.scenes import draft_scene, scene_mesh
from ocnf_data.synthesis.draw import Body, Look
from ocnf_data.synthesis.scenes import PlacedScene, look_cameras, place_scene, truth_cameras
from ocnf_data.views.cameras import Views
from ocnf_data.views.misalignment import misalign
from ocnf_data.views.noise import NoiseModel, add_noise, view_noise
from ocnf_data.views.sensor import add_sensor_noise, sensor_draws

Truths = dict[int, RawOctree]
"""The ground truth of a body at each resolution, voxels along each axis."""


@dataclass(frozen=True, eq=False)
class Posed:
    """A body's mesh with its vertices (N, 3) where the cameras look: metres in the grid's cube.

    `scene` is where a procedural scene stands in it; None for meshes and shapes.
    """

    mesh: Mesh
    vertices: F64
    scene: PlacedScene | None = None


def pose(manifest: Manifest, body: Body, meshes: str | os.PathLike[str] | None) -> Posed:
    """Read or make the mesh, turn it, and scale it into the cube.

    Raises:
        OcnfError: the mesh cannot be used, with the code of `read_mesh`; `changed` where it is another file
            than the one whose checksum was taken.
    """
    extent, padding = manifest.normalise.extent, manifest.normalise.padding
    if body.is_scene:
        assert body.item.index is not None
        draft = draft_scene(body.item.category, manifest.seed, body.item.index, body.item.split)
        mesh = scene_mesh(draft)
        scene = place_scene(draft, mesh, body, extent, padding)
        return Posed(mesh, scene.into_cube(mesh.vertices), scene)
    mesh = read_item(manifest, body.item, meshes)
    if body.rotation is not None:
        mesh = replace(mesh, vertices=mesh.vertices @ body.rotation.T)
    vertices, _ = normalise(mesh, extent, padding)
    return Posed(mesh, vertices if body.scale == 1 else vertices * body.scale)


def make_truths(manifest: Manifest, posed: Posed, resolutions: tuple[int, ...]) -> Truths:
    """The ground truth, fused from all views of the rig; in a scene from as many single cameras.

    Raises:
        OcnfError: `invisible` where no view sees any of the mesh, `crowded` where a scene has no place for a
            camera.
    """
    if posed.scene is None:
        views = render_item(manifest, posed.vertices, posed.mesh)
    else:
        R, T = truth_cameras(posed.scene, manifest.seed, manifest.camera.n_views)
        views = _render_scene(manifest, posed, R, T)
    if not np.isfinite(views.depth).any():
        raise OcnfError("no camera sees any of the mesh", code="invisible")
    pyramid = DepthPyramid(views)
    return {resolution: quantise(fuse_truth(manifest, pyramid, resolution), TARGET)
            for resolution in resolutions}


def make_inputs(manifest: Manifest, posed: Posed, look: Look, encoding: Encoding,
                resolutions: tuple[int, ...]) -> Truths:
    """The input, fused from the noisy views of the look, by poses that may be off.

    Raises:
        OcnfError: `crowded` where a scene has no place for the cameras.
    """
    if posed.scene is None:
        metres = (manifest.synthesis or Synthesis()).metres
        views = render_item(manifest, posed.vertices, posed.mesh, look.directions)
    else:
        metres = posed.scene.metres
        R, T = look_cameras(posed.scene, look)
        views = _render_scene(manifest, posed, R, T)
        if not look.background:
            views = views.without_background()
    voxel = manifest.normalise.extent / max(manifest.resolutions)
    observed = observe_look(views, look, metres)
    pyramid = DepthPyramid(misalign(observed, look.misaligned * voxel, look.seed, look.key))
    return {resolution: quantise(fuse_input(manifest, pyramid, encoding, resolution), encoding)
            for resolution in resolutions}


def observe_look(views: Views, look: Look, metres: float) -> Views:
    """The views of a look with its noise; `metres` are real ones that one of the depth stands for."""
    size = views.size
    match look.noise:
        case NoiseModel.KINECT:
            depth = [add_sensor_noise(image, K, sensor_draws(look.seed, look.key, view, size), look.strength,
                                      metres)
                     for image, K, view in zip(views.depth, views.K, look.views, strict=True)]
        case NoiseModel.PARK if look.sigma > 0:
            depth = [add_noise(image, look.sigma, view_noise(look.seed, look.key, view, size))
                     for image, view in zip(views.depth, look.views, strict=True)]
        case _:
            return views
    return views.with_depth(np.stack(depth))


def _render_scene(manifest: Manifest, posed: Posed, R: F64, T: F64) -> Views:
    """Views of a scene by the manifest's pinhole at poses R (V, 3, 3), T (V, 3)."""
    camera = manifest.camera
    depth = render_depth(posed.vertices, posed.mesh.faces, camera.K, R, T, camera.size, manifest.renderer,
                         manifest.normalise.near)
    return Views(depth, camera.K, R, T)
