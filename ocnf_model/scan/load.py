"""From the name of a run to a network that fuses: what a program needs that has depth frames.

Nothing of training is loaded: the weights are read from their files, and the network runs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import Scan
from ocnf_model.checkpoint import PRETRAINED, TrainedRun, open_run
from ocnf_model.devices import pick_device
from ocnf_model.header import Header
from ocnf_model.network import OctNetFusion
from ocnf_model.scan.frames import limit_depth
from ocnf_model.scan.fuse import fuse_scan
from ocnf_model.scan.fusers import Learned
from ocnf_model.scan.reconstruction import Reconstruction
from ocnf_model.scan.region import Region


@dataclass(frozen=True, eq=False)
class TrainedNetwork:
    """A network with its weights, what they were trained on, and the way from depth to a surface.

    Attributes:
        run: where it comes from.
    """

    run: TrainedRun

    @property
    def module(self) -> OctNetFusion:
        """The PyTorch module, in evaluation mode, on the device that it was loaded to."""
        return self.run.network

    @property
    def headers(self) -> tuple[Header, ...]:
        """What each level's checkpoint says of itself, coarse to fine: data, settings, validation."""
        return self.run.headers

    @property
    def resolutions(self) -> list[int]:
        """Voxels along each axis of each level, coarse to fine."""
        return self.run.resolutions

    def fuse(self, scan: Scan | Views, *, box: Sequence[float] | None = None, room: bool = False,
             voxel: float | None = None, resolution: int | None = None, max_depth: float | None = None,
             keep_unseen: bool = False, keep_all: bool = False, faces: int | None = None,
             report: Callable[[int, int], None] | None = None) -> Reconstruction:
        """Reconstruct the surface of one object or region from depth frames with known poses.

        Args:
            scan: what `read_scan` or `Scan.from_arrays` gives, or bare views: depth in metres, 0 where
                nothing was measured, cameras after OpenCV.
            box: x0 y0 z0 x1 y1 z1 in metres, in the coordinates of the poses. None: the cube that the scan
                names, else the box around the largest connected surface.
            room: everything that the frames see, in place of the largest surface.
            voxel: metres; the region is worked in as many cubes of the network as that takes. None: it fits
                one cube.
            resolution: the last level to run; None: all of them, or (with `voxel`) the first whose cube holds
                the region.
            max_depth: metres; what was measured beyond is not used.
            keep_unseen: keep the walls that close off what no camera has seen.
            keep_all: keep loose parts of the surface, of less than 16 voxels.
            faces: decimate to about so many.
            report: told (cubes done, cubes in all) after each; only with `voxel`.

        Raises:
            OcnfError: the box is none, the network has no such level, the voxels need more memory than there
                is (`too_large`), or no surface is left (`empty`).
        """
        if isinstance(scan, Views):
            scan = Scan(scan, tuple(f"frame {i}" for i in range(len(scan))))
        if not isinstance(scan, Scan):
            raise OcnfError("not depth frames", where="fuse", field="scan", found=type(scan).__name__,
                            expected="a Scan or Views", fix="read a folder of frames with read_scan(FOLDER)")
        region = None if box is None else Region.of_box(box)
        return fuse_scan(limit_depth(scan, max_depth), Learned.of(self.run, resolution), region=region,
                         room=room, voxel=voxel, keep_unseen=keep_unseen, keep_all=keep_all, faces=faces,
                         report=report)


def load_network(run: str | os.PathLike[str] = PRETRAINED, *, device: str = "auto") -> TrainedNetwork:
    """The trained network of a run.

    Args:
        run: a folder that `ocnf-model train` left, or one of the networks that come with the package:
            `pretrained`, `pretrained-scan`.
        device: `auto` (a GPU where there is one), `cpu`, `cuda`, `cuda:1`.

    Raises:
        OcnfError: there is no such run or no such device, or its checkpoints are damaged or do not go
            together.
    """
    trained = open_run(os.fspath(run))
    trained.network.to(pick_device(device))
    return TrainedNetwork(trained)
