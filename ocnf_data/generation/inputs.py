"""Ground truth and inputs out of views: what samples of meshes and of scans have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ocnf_data.arrays import F32
from ocnf_data.encodings import Encoding
from ocnf_data.fusion import DepthPyramid, fuse, fuse_tsdf
from ocnf_data.generation.procedural import is_configuration, is_scene
from ocnf_data.generation.records import Stages
from ocnf_data.manifest import Manifest, Target, Variant
from ocnf_data.octree import GridOctree
from ocnf_data.octree.codec import encode
from ocnf_data.octree.occupied import occupied
from ocnf_data.shards.tarformat import input_member
from ocnf_data.views.cameras import Views
from ocnf_data.views.noise import add_noise, view_noise
from ocnf_data.views.normalisation import Normalisation
from ocnf_data.views.sensor import SensorDraws, add_sensor_noise, sensor_draws


def fuse_truth(manifest: Manifest, pyramid: DepthPyramid, resolution: int) -> GridOctree:
    """The ground truth, out of all views of the rig without noise."""
    return as_target(manifest, fuse_tsdf(pyramid, resolution, manifest.normalise.extent,
                                         manifest.truncation(resolution)))


def as_target(manifest: Manifest, tsdf: GridOctree) -> GridOctree:
    """What the manifest's `target` takes of a TSDF."""
    return occupied(tsdf) if manifest.target is Target.OCCUPANCY else tsdf


def fuse_input(manifest: Manifest, pyramid: DepthPyramid, encoding: Encoding, resolution: int) -> GridOctree:
    """An input, out of the views that it sees."""
    return fuse(pyramid, encoding, resolution, manifest.normalise.extent, manifest.truncation(resolution))


def real_metres(variant: Variant, source: str, normalisation: Normalisation) -> float:
    """How many real metres a metre of the cube stands for, in an input of an item with this source.

    Scenes and scans have real sizes, which were scaled into the cube; what the size of a mesh means its
    variant has to say.
    """
    has_size = is_configuration(source) or is_scene(source)
    return variant.metres / normalisation.scale if has_size else variant.metres


def observe(seen: Views, indices: Sequence[int], variant: Variant, noise: Noise, metres: float) -> Views:
    """The noisy views that an input is made of.

    Args:
        seen: the views without noise.
        indices: number of each of them among all views of the item, on which its noise depends.
        variant: the input.
        noise: noise of the item.
        metres: of `real_metres`.
    """
    if variant.noise == "kinect":
        return seen.with_depth(np.stack([
            add_sensor_noise(depth, K, noise.sensor(view), variant.strength, metres)
            for view, depth, K in zip(indices, seen.depth, seen.K, strict=True)]))
    if variant.sigma == 0:
        return seen
    return seen.with_depth(np.stack([add_noise(depth, variant.sigma, noise(view))
                                     for view, depth in zip(indices, seen.depth, strict=True)]))


class Noise:
    """Noise of each view of one item, drawn once for all variants."""

    def __init__(self, seed: int, key: str, size: tuple[int, int]) -> None:
        self._seed, self._key, self._size = seed, key, size
        self._drawn: dict[int, F32] = {}

    def sensor(self, view: int) -> SensorDraws:
        """The draws of `views.sensor`: six numbers a pixel, drawn again rather than held."""
        return sensor_draws(self._seed, self._key, view, self._size)

    def __call__(self, view: int) -> F32:
        """The standard normal noise (H, W) of Park's model."""
        if view not in self._drawn:
            self._drawn[view] = view_noise(self._seed, self._key, view, self._size)
        return self._drawn[view]


class SampleOctrees:
    """The encoded octrees of one sample, in the order in which they are added.

    Args:
        manifest: the manifest of the data set.
        stages: records each stage and its time.

    Attributes:
        members: payload by member name.
        leaf_counts: leaves by member name.
    """

    def __init__(self, manifest: Manifest, stages: Stages) -> None:
        self._manifest, self._stages = manifest, stages
        self.members: dict[str, bytes] = {}
        self.leaf_counts: dict[str, int] = {}

    def add(self, name: str, octree: GridOctree, kind: Encoding | str) -> None:
        """Encode an octree under a member's name."""
        with self._stages("encode"):
            self.members[name] = encode(octree, kind)
        self.leaf_counts[name] = octree.n_leaves

    def add_inputs(self, variant: Variant, seen: Views, indices: Sequence[int], noise: Noise,
                   metres: float) -> None:
        """Fuse an input in all its encodings at all resolutions; arguments as for `observe`."""
        with self._stages("noise"):
            noisy = observe(seen, indices, variant, noise, metres)
        with self._stages("pyramid"):
            pyramid = DepthPyramid(noisy)
        for encoding in variant.encodings:
            for resolution in self._manifest.resolutions:
                with self._stages("fuse inputs"):
                    octree = fuse_input(self._manifest, pyramid, encoding, resolution)
                self.add(input_member(variant.name, encoding, resolution), octree, encoding)


def noise_facts(variant: Variant, metres: float) -> dict[str, Any]:
    """What a sample's facts say of an input's noise; `metres` of `real_metres`."""
    if variant.noise == "park":
        return {"sigma": variant.sigma}
    return {"noise": variant.noise, "strength": variant.strength, "metres": metres}
