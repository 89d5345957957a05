"""The methods that make a TSDF of depth: plain fusion (VolFus), TV-L1, and the network.

The network knows one cube. A region of the scan takes that cube's place: fusion measures everything in
voxels and in truncations, so that a cube of any size, anywhere, gives what the scan would, were it moved and
scaled into the cube of training, and the surface is in the scan's coordinates at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid, default_truncation, fuse, fuse_histogram, fuse_tsdf
from ocnf_data.octree import GridOctree
from ocnf_model.baselines import tvl1
from ocnf_model.baselines.total_variation import check_weight
from ocnf_model.checkpoint import TrainedRun
from ocnf_model.evaluation.levels import run_levels
from ocnf_model.evaluation.methods import Method
from ocnf_model.network import OctNetFusion, Output
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.scan.region import Region

Told = Callable[[int, int], None]


@dataclass(frozen=True)
class Baseline:
    """VolFus, or TV-L1 where there is a weight.

    Raises:
        OcnfError: a resolution that is no multiple of 8, or a weight that is not above 0.
    """

    resolution: int = 256
    weight: float | None = None

    def __post_init__(self) -> None:
        default_truncation(self.resolution)  # which checks it
        if self.weight is not None:
            check_weight(self.weight)

    def __call__(self, pyramid: DepthPyramid, region: Region, report: Told | None = None,
                 ) -> dict[int, GridOctree]:
        """The region's cube by resolution, of which there is one: TSDF / tau, 1 channel."""
        size, centre = region.size, region.centre
        if self.weight is None:
            return {self.resolution: fuse_tsdf(pyramid, self.resolution, size, centre=centre)}
        votes = fuse_histogram(pyramid, self.resolution, size, centre=centre)
        return {self.resolution: tvl1(votes, self.weight)}

    @property
    def method(self) -> Method:
        """Which of the two it is."""
        return Method.VOLFUS if self.weight is None else Method.TVL1

    @property
    def overlap(self) -> int:
        """Voxels that neighbouring tiles share: VolFus looks at one voxel, TV-L1 at all around it."""
        return 0 if self.weight is None else self.resolution // 8 // 8 * 8

    def truncation(self, voxel: float) -> float:
        """Truncation distance in metres where voxels are as large, the paper's."""
        return default_truncation(self.resolution, voxel * self.resolution)

    def for_voxels(self, n: int) -> Baseline:
        """The same: a tile costs what lies in it."""
        return self


@dataclass(frozen=True, eq=False)
class Learned:
    """The network.

    Attributes:
        network: the network in evaluation mode, on the device that it runs on.
        resolutions: resolutions of its levels, coarse to fine; a shorter list makes it stop early.
        truncation_voxels: truncation distance in voxels that it was trained with.
        fixed: whether the last resolution was asked for.
    """

    network: OctNetFusion
    resolutions: Sequence[int]
    truncation_voxels: float = 32 / 15
    fixed: bool = False

    @classmethod
    def of(cls, trained: TrainedRun, resolution: int | None = None) -> Learned:
        """A run's network up to the level of a resolution; None: all its levels.

        Raises:
            OcnfError: it has no such level, or is one of completion.
        """
        trained.network.check_plain(trained.path)
        levels = trained.resolutions
        if resolution is not None and resolution not in levels:
            raise OcnfError("the network has no level of this resolution", where=trained.path,
                            field="resolution", found=resolution, expected=" or ".join(map(str, levels)))
        used = levels[: levels.index(resolution) + 1] if resolution else levels
        return cls(trained.network, used, trained.data.truncation_voxels, resolution is not None)

    @property
    def method(self) -> Method:
        """The network's name among the methods."""
        return Method.OURS

    @property
    def resolution(self) -> int:
        """Voxels along each axis of the finest level."""
        return self.resolutions[-1]

    @property
    def overlap(self) -> int:
        """Voxels that neighbouring tiles share, a quarter of a tile.

        A level looks 24 of its voxels around, and a little more where leaves are wide; three levels together
        168 of the finest, which is more than there is to share. What lies far off hardly counts.
        """
        step = 8 << (len(self.resolutions) - 1)  # so that the trees of all levels lie alike in all tiles
        return max(self.resolution // 4 // step, 1) * step

    def truncation(self, voxel: float) -> float:
        """Truncation distance in metres where voxels are as large: as many voxels as in training."""
        return self.truncation_voxels * voxel

    def for_voxels(self, n: int) -> Learned:
        """The network that stops at the first level whose cube holds n voxels; itself where none does."""
        fitting = [i for i, resolution in enumerate(self.resolutions, 1) if resolution >= n]
        if self.fixed or not fitting:
            return self
        return Learned(self.network, self.resolutions[: fitting[0]], self.truncation_voxels)

    def __call__(self, pyramid: DepthPyramid, region: Region, report: Told | None = None,
                 ) -> dict[int, GridOctree]:
        """The region's cube by resolution, coarse to fine, 1 channel each.

        TSDF / tau, or 1 - 2 p of the probability p of being occupied. `report` is told (levels run, levels in
        all) after each.
        """
        network, size = self.network, region.size
        inputs = [OctreeBatch.from_grids([
            fuse(pyramid, network.encoding, resolution, size, self.truncation(size / resolution),
                 centre=region.centre)]) for resolution in network.reads(self.resolutions)]
        reached = run_levels(network, inputs, next(network.parameters()).device, len(self.resolutions))
        octrees = {}
        for resolution, level in zip(self.resolutions, reached, strict=True):
            octrees[resolution] = self._signed(level.reconstruction)
            if report is not None:
                report(len(octrees), len(self.resolutions))
        return octrees

    def _signed(self, reconstruction: OctreeBatch) -> GridOctree:
        field = reconstruction.features
        signed = 1 - 2 * field if self.network.output is Output.OCCUPANCY else field.clamp(-1, 1)
        return reconstruction.with_features(signed).to_grids()[0]


Fuser = Baseline | Learned


def fuse_tile(fuser: Fuser, pyramid: DepthPyramid, cube: Region) -> GridOctree:
    """The finest octree of one of many tiles; where no surface was measured, that of plain fusion."""
    if isinstance(fuser, Learned):
        def plain(resolution: int) -> GridOctree:
            return fuse_tsdf(pyramid, resolution, cube.size, fuser.truncation(cube.size / resolution),
                             centre=cube.centre)

        if not (np.abs(plain(fuser.resolutions[0]).data) < 1).any():
            return plain(fuser.resolution)
    return fuser(pyramid, cube)[fuser.resolution]
