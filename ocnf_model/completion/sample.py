"""A frame as the network takes it: octrees of its input and its ground truth at each resolution."""

from __future__ import annotations

import os
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ocnf_data.arrays import F32
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.octree import GridOctree
from ocnf_data.octree.symmetry import Symmetry
from ocnf_model.completion.encoding import FREE_SPACE, UNKNOWN, coarser, coarser_targets, encode_view, targets
from ocnf_model.completion.padding import padded, padded_shape
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import Visible

SAMPLE_VERSION = "ocnf.completion.1"
"""Another one wherever the same frame would give other octrees."""
SIZE = 128
"""Voxels along the sides of the network's grid, at its finest resolution."""
LEVELS = 2
"""Resolutions of a sample: 64 and 128 along the sides."""
SHRINK = 2
"""Voxels of a scene along a voxel of the finest resolution: 5 mm become 10 mm."""
# Of a file that is empty, cut off or changed; RuntimeError where a member looks encrypted, or packed in a way
# that zipfile does not know.
_NOT_ONE = (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error, OcnfError)
_TOLERANCE = (0.02, 0.2)  # of the inputs' octrees, coarse to fine


@dataclass(frozen=True, eq=False)
class FrameSample:
    """Octrees of one frame, coarse to fine.

    Attributes:
        name: name of the scene and the frame.
        inputs: `CHANNELS` channels each, see `encoding.encode_view`.
        targets: 1 channel each: occupancy in [0, 1], or `UNKNOWN`.
    """

    name: str
    inputs: tuple[GridOctree, ...]
    targets: tuple[GridOctree, ...]

    def moved(self, symmetry: Symmetry) -> FrameSample:
        """The sample turned or mirrored."""
        return FrameSample(self.name, tuple(map(symmetry, self.inputs)), tuple(map(symmetry, self.targets)))

    @classmethod
    def of(cls, scene: Tabletop) -> FrameSample:
        """Encode a scene and its ground truth.

        Raises:
            OcnfError: the scene's grid is larger than the network's.
        """
        visible = Visible.of(scene.view, scene.shape, scene.voxel)
        target = coarser_targets(padded(targets(scene, visible), _even(scene.shape), UNKNOWN))
        truths = [padded(target, grid_shape(scene), UNKNOWN)]
        for _ in range(LEVELS - 1):
            truths.insert(0, coarser_targets(truths[0]))
        return cls(scene.name, input_octrees(scene, visible),
                   tuple(GridOctree.from_dense(truth[None], 0.0) for truth in truths))


def grid_shape(scene: Tabletop) -> tuple[int, int, int]:
    """(D, H, W) of the network's finest grid for a scene, with a square base so that it can be turned.

    Raises:
        OcnfError: the scene is larger.
    """
    if max(scene.shape) > SHRINK * SIZE:
        raise OcnfError("the scene is larger than the network's grid", where=scene.name, field="shape",
                        found=scene.shape, expected=f"at most {SHRINK * SIZE} voxels along each axis")
    depth, _, _ = padded_shape(scene.shape, SHRINK * 32 << (LEVELS - 1))
    return depth // SHRINK, SIZE, SIZE


def _even(shape: tuple[int, int, int]) -> tuple[int, int, int]:
    return padded_shape(shape, SHRINK)


def input_octrees(scene: Tabletop, visible: Visible) -> tuple[GridOctree, ...]:
    """The encoded view at each resolution, coarse to fine."""
    volume = coarser(_padded_free(encode_view(scene, visible), _even(scene.shape)))
    volumes = [_padded_free(volume, grid_shape(scene))]
    for _ in range(LEVELS - 1):
        volumes.insert(0, coarser(volumes[0]))
    return tuple(GridOctree.from_dense(volume, tolerance)
                 for volume, tolerance in zip(volumes, _TOLERANCE, strict=True))


def _padded_free(volume: F32, shape: tuple[int, int, int]) -> F32:
    return np.stack([padded(channel, shape, value)
                     for channel, value in zip(volume, FREE_SPACE, strict=True)])


def kept(folder: Path, name: str) -> Path:
    """The file of a sample in a cache's folder; samples of another version have other files."""
    return folder / f"{SAMPLE_VERSION}-{name.replace(os.sep, '-')}.npz"


def save_sample(file: Path, sample: FrameSample) -> None:
    """Write a sample, whole or not at all."""
    import io

    arrays = {}
    for kind, octrees in (("input", sample.inputs), ("target", sample.targets)):
        for level, octree in enumerate(octrees):
            arrays[f"{kind}{level}.trees"] = octree.trees
            arrays[f"{kind}{level}.data"] = octree.data.astype(np.float16)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    Store(file.parent).put_bytes(file.name, buffer.getvalue())


def load_sample(file: Path, name: str, levels: int = LEVELS) -> FrameSample:
    """Read what `save_sample` wrote, the first so many levels of it.

    Raises:
        OcnfError: it is damaged.
    """
    try:
        with zipfile.ZipFile(file) as archive:  # numpy reads an array's header before it is known to be whole
            if (bad := archive.testzip()) is not None:
                raise zipfile.BadZipFile(f"the checksum of {bad} does not match")
        with np.load(file, allow_pickle=False) as arrays:
            inputs, truths = ([GridOctree(arrays[f"{kind}{level}.trees"],
                                          arrays[f"{kind}{level}.data"].astype(np.float32))
                               for level in range(levels)] for kind in ("input", "target"))
    except _NOT_ONE as error:
        raise OcnfError("not a kept sample", code="damaged", where=file, found=error,
                        fix="delete it: it is made again") from error
    return FrameSample(name, tuple(inputs), tuple(truths))


def finer(values: F32, shape: tuple[int, int, int], shrink: int = SHRINK) -> F32:
    """A grid of voxels `shrink` times as wide as the scene's, interpolated linearly to those, (D, H, W)."""
    for axis, size in enumerate(shape):
        at = np.clip((np.arange(size) + 0.5) / shrink - 0.5, 0, values.shape[axis] - 1)  # voxel centres
        low = np.floor(at).astype(np.int64)
        high = np.minimum(low + 1, values.shape[axis] - 1)
        weight = (at - low).astype(np.float32).reshape([-1 if i == axis else 1 for i in range(3)])
        values = np.take(values, low, axis) * (1 - weight) + np.take(values, high, axis) * weight
    return values
