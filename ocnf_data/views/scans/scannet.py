"""A scene of ScanNet (Dai et al. 2017) as its SensReader extracts it.

    depth/N.png                       16 bits, millimetres; 0 is no measurement
    pose/N.txt                        4x4, camera to world, metres; -inf where the tracking was lost
    intrinsic/intrinsic_depth.txt     4x4, pixels of the depth map
    intrinsic/intrinsic_color.txt     4x4, pixels of the colour image
    color/N.jpg                       larger than the depth map; may be missing
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.views.scans.listing import (
    Frame,
    Listing,
    ScanFormat,
    check_pinhole,
    numbered,
    own_intrinsics,
    unmatched,
)
from ocnf_data.views.scans.text import read_matrix


def _fits(folder: Path) -> bool:
    return (folder / "depth").is_dir() and (folder / "intrinsic").is_dir()


def _read(folder: Path, given: bool) -> Listing:
    depths, poses = numbered(folder / "depth", {".png"}), numbered(folder / "pose", {".txt"})
    if not depths:
        raise OcnfError("holds no frames", code="empty", where=folder, expected="depth/*.png")
    if not poses:
        raise OcnfError("has no poses", code="missing", where=folder, expected="pose/*.txt",
                        fix="extract them with SensReader's --export_poses")
    colours = numbered(folder / "color", {".jpg", ".jpeg", ".png"})
    inner = folder / "intrinsic"
    K = own_intrinsics(lambda: _pinhole(inner / "intrinsic_depth.txt"), given)
    K_colour = own_intrinsics(lambda: _pinhole(inner / "intrinsic_color.txt"), given) if colours else None
    frames = [Frame(name, depth, read_matrix(poses[name], 4, 4), poses[name], K, colours.get(name), K_colour)
              for name, depth in depths.items() if name in poses]
    return Listing(tuple(frames), notes=tuple(unmatched(depths, poses)))


def _pinhole(file: Path) -> F64:
    """The 3x3 part of a 4x4 matrix."""
    whole = read_matrix(file, 4, 4)
    rest = whole.copy()
    rest[:3, :3] = np.eye(3)
    if not np.array_equal(rest, np.eye(4)):
        raise OcnfError("not intrinsics", where=file, found=whole.tolist(),
                        expected="K in the upper left of 4x4, 0 0 0 1 around it")
    return check_pinhole(whole[:3, :3], file)


SCANNET = ScanFormat("scannet", "depth/, pose/ and intrinsic/ of ScanNet's SensReader", _fits, _read)
