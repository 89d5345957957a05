"""One's own depth map completed: the table is found, the network asked, and a surface cut out.

    completed = complete_view(CompletionNetwork("pretrained"), scan.views.subset([3]))
    completed.save("things.ply")
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from ocnf_data.arrays import F32, F64, I64, Bool
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.storage import Store
from ocnf_data.files.targets import check_target
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import read_scan
from ocnf_model.completion.predict import CompletionNetwork
from ocnf_model.completion.table import VOXEL, TableGrid, find_table
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST

_SUFFIXES = (".npz", *WRITERS)


@dataclass(frozen=True, eq=False)
class CompletedView:
    """What stands on the table, seen and not seen.

    Attributes:
        grid: where the grid lies.
        probability: (D, H, W) in [0, 1] of being occupied, axes z, y, x of the grid.
        threshold: from where on a voxel counts as occupied.
        vertices: (N, 3) float64 metres in the world of the view.
        faces: (M, 3) int64, looking outwards; things are closed where they stand on the table.
    """

    grid: TableGrid
    probability: F32
    threshold: float
    vertices: F64
    faces: I64

    @property
    def occupied(self) -> Bool:
        """(D, H, W): the voxels above the table that count as occupied."""
        occupied = self.probability >= self.threshold
        occupied[:LOWEST] = False
        return np.asarray(occupied)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the mesh, or with .npz `probability`, `occupied`, `to_grid` (4, 4) and `voxel` in metres.

        Raises:
            OcnfError: another ending, or the file cannot be written.
        """
        file = Path(path)
        check_target(file, _SUFFIXES)
        if file.suffix.lower() == ".npz":
            buffer = io.BytesIO()
            np.savez_compressed(buffer, probability=self.probability, occupied=self.occupied,
                                to_grid=self.grid.to_grid, voxel=np.float64(VOXEL))
            data = buffer.getvalue()
        else:
            data = WRITERS[file.suffix.lower()](self.vertices, self.faces, None)
        Store(file.parent).put_bytes(file.name, data)


def complete_view(network: CompletionNetwork, view: Views, name: str = "view") -> CompletedView:
    """Complete what stands on the table that a view looks at.

    Args:
        network: `CompletionNetwork("pretrained")`, or one of your own.
        view: a single view in metres, its camera after OpenCV, in any world.
        name: names the frame in errors.

    Raises:
        OcnfError: several views; no table is seen, or nothing on it (`empty`), or too much (`too_large`).
    """
    if len(view) != 1:
        raise OcnfError("completion starts from a single view", where=name, field="view",
                        found=f"{len(view)} views", expected=1)
    grid = find_table(view, name)
    unknown = np.full(grid.shape, np.nan, np.float32)
    probability = network.probability(Tabletop(name, grid.place(view), VOXEL, unknown))
    vertices, faces = _cut(probability, network.threshold)
    return CompletedView(grid, probability, network.threshold, grid.leave(vertices), faces)


def run_complete_frame(run: str, scan: str, out: Path, *, frame: str | None = None, device: str = "auto",
                       console: Console | None = None) -> CompletedView:
    """Complete a frame of a scan, write it, and say what was found.

    Args:
        run: folder of a run, or `pretrained`.
        scan: a scan in any format that `read_scan` knows.
        out: .npz or a mesh, see `CompletedView.save`.
        frame: the name of one of its frames, or its number from 0; None for the first.
        device: `auto`, `cpu`, `cuda`.
        console: where it is said; None: on the standard output.
    """
    console = console or Console(emoji=False)
    check_target(out, _SUFFIXES)
    network = CompletionNetwork(run, device)
    read = read_scan(scan, colour=False)
    for warning in read.warnings:
        console.print(f"Warning: {warning}", highlight=False, markup=False)
    number = _number(frame, read.names, scan)
    done = complete_view(network, read.views.subset([number]), f"{scan}: {read.names[number]}")
    done.save(out)
    depth, height, width = (n * VOXEL for n in done.grid.shape)
    litres = float(done.occupied.sum()) * VOXEL**3 * 1000
    console.print(f"{out}: {read.names[number]}, {litres:.2f} litres of things in a grid of {width:.2f} x "
                  f"{height:.2f} x {depth:.2f} m on the table, {len(done.faces):,} faces", highlight=False,
                  markup=False)
    return done


def _number(frame: str | None, names: tuple[str, ...], scan: str) -> int:
    if frame is None:
        return 0
    if frame in names:
        return names.index(frame)
    if frame.isascii() and frame.isdecimal() and int(frame) < len(names):
        return int(frame)
    raise OcnfError("the scan has no such frame", code="missing", where=scan, field="frame", found=frame,
                    expected=f"0 to {len(names) - 1}, or a name such as {names[0]}")


def _cut(probability: F32, threshold: float) -> tuple[F64, I64]:
    """Vertices (x, y, z) in metres of the grid, and faces, at the threshold; closed at the table."""
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise missing_extra("cutting the surface out needs scikit-image", "fuse") from error
    values = np.pad(probability[LOWEST:], 1)
    if not (values >= threshold).any():
        raise OcnfError("the network holds nothing on the table for occupied", code="empty")
    vertices, faces, _, _ = marching_cubes(values, threshold)
    vertices = (vertices[:, ::-1].astype(np.float64) - 0.5) * VOXEL + [0, 0, LOWEST * VOXEL]
    return vertices, faces.astype(np.int64)
