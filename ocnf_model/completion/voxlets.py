"""The Voxlets tabletop set of Firman et al.: frames of a split with the ground truth of their scenes.

    ROOT/train_test/{train,test}.yaml     frames of each split: `folder`, `scene`, `frames` (their numbers)
    ROOT/fold_K/SCENE/                    a scan (see `ocnf_data.views.scans.voxlets`), and
        tsdf_meta.yaml                    `shape` (X, Y, Z) and `voxelsize` in metres
        tsdf.dat                          float16 (X, Y, Z), metres, negative inside, NaN unknown

A folder that ends in `data` is `fold_0`, one in `data1` is `fold_1`. Scenes that are not there (the set comes
in parts) are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ocnf_data.arrays import F32
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.files.strict_yaml import read_yaml
from ocnf_data.views.scans import read_scan
from ocnf_model.completion.tabletop import Tabletop

_SPLITS = ("train", "test")
_FOLDS = {"data": "fold_0", "data1": "fold_1"}
_MAX_VOXELS = 2**28


@dataclass(frozen=True)
class VoxletsFrame:
    """A frame of a split.

    Attributes:
        scene: folder of the scene, which is there.
        number: number of the frame.
    """

    scene: Path
    number: int

    @property
    def name(self) -> str:
        """`fold_1/saved_00205/331`: scenes of two folds may have one name."""
        return f"{self.scene.parent.name}/{self.scene.name}/{self.number}"

    def read(self) -> Tabletop:
        """The depth map and the ground truth.

        Raises:
            OcnfError: a file is missing or damaged, or the scene has no such frame.
        """
        scan = read_scan(self.scene, format="voxlets")
        numbers = [int(name) for name in scan.names]
        if self.number not in numbers:
            raise OcnfError("the scene has no such frame", code="missing", where=self.scene, field="frame",
                            found=self.number, expected=f"one of {sorted(numbers)}")
        view = scan.views.subset([numbers.index(self.number)])
        tsdf, voxel = read_truth(self.scene)
        return Tabletop(self.name, view, voxel, tsdf)


def list_frames(root: str | Path, split: str) -> list[VoxletsFrame]:
    """The frames of a split whose scenes are there, sorted by fold, scene and number.

    Raises:
        OcnfError: no such split, no list of it, or none of its scenes is there.
    """
    if split not in _SPLITS:
        raise OcnfError("no such split", field="split", found=split, expected=" or ".join(_SPLITS))
    folder = Path(root).expanduser()
    file = folder / "train_test" / f"{split}.yaml"
    rows = read_yaml(file)
    if not isinstance(rows, list):
        raise OcnfError("not a list of frames", where=file, found=type(rows).__name__)
    frames = {frame for i, row in enumerate(rows) for frame in _frames(folder, file, i, row)}
    if not frames:
        raise OcnfError("none of the split's scenes is there", code="missing", where=folder, field=split,
                        expected="fold_0 and fold_1 with their scenes")
    return sorted(frames, key=lambda frame: (frame.scene, frame.number))


def _frames(root: Path, file: Path, i: int, row: Any) -> Iterator[VoxletsFrame]:
    where = f"[{i}]"
    if not isinstance(row, dict):
        raise OcnfError("not a frame", where=file, field=where, found=row,
                        expected="folder, scene and frames")
    fold = _FOLDS.get(PurePosixPath(str(row.get("folder"))).name)
    if fold is None:
        raise OcnfError("not a fold", where=file, field=f"{where}.folder", found=row.get("folder"),
                        expected="a path that ends in data or data1")
    scene, numbers = row.get("scene"), row.get("frames")
    if not isinstance(scene, str) or scene != PurePosixPath(scene).name or scene in ("", ".", ".."):
        raise OcnfError("not the name of a scene", where=file, field=f"{where}.scene", found=scene)
    if not isinstance(numbers, list) or not all(type(n) is int for n in numbers):
        raise OcnfError("not numbers of frames", where=file, field=f"{where}.frames", found=numbers)
    if (folder := root / fold / scene).is_dir():
        yield from (VoxletsFrame(folder, n) for n in numbers)


def read_truth(scene: Path) -> tuple[F32, float]:
    """((D, H, W) float32 TSDF in metres, NaN unknown; edge length of a voxel in metres) of a scene's folder.

    Raises:
        OcnfError: a file is missing, or does not fit the other; nothing is known (`empty`).
    """
    meta = scene / "tsdf_meta.yaml"
    data = read_yaml(meta, tuples=True)
    shape, voxel = (data.get("shape"), data.get("voxelsize")) if isinstance(data, dict) else (None, None)
    if not isinstance(shape, list | tuple) or len(shape) != 3 \
            or not all(type(n) is int and n > 0 for n in shape) or math.prod(shape) > _MAX_VOXELS:
        raise OcnfError("not the shape of a volume", where=meta, field="shape", found=shape,
                        expected="three whole numbers (X, Y, Z)")
    if not isinstance(voxel, int | float) or not math.isfinite(voxel) or voxel <= 0:
        raise OcnfError("not the edge length of a voxel", where=meta, field="voxelsize", found=voxel,
                        expected="metres > 0")
    file = scene / "tsdf.dat"
    with storage_errors(file):
        raw = file.read_bytes()
    if len(raw) != 2 * math.prod(shape):
        raise OcnfError("the volume has another size", code="damaged", where=file,
                        found=f"{len(raw)} bytes", expected=f"{2 * math.prod(shape)} of float16 {shape}")
    tsdf = np.frombuffer(raw, "<f2").reshape(shape).transpose(2, 1, 0)  # (X, Y, Z) -> (D, H, W)
    if np.isnan(tsdf).all():
        raise OcnfError("nothing of the scene is known", code="empty", where=file, found="NaN everywhere",
                        expected="metres to the surface")
    return np.ascontiguousarray(tsdf, dtype=np.float32), float(voxel)
