"""The files of a fused scan. Whether they can be written is found out before anything is fused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.storage import Store
from ocnf_data.files.targets import check_file
from ocnf_data.meshes.writing import WRITERS
from ocnf_model.scan.reconstruction import Reconstruction

TSDF_SUFFIXES = (".npz", ".oc")
_MAX_DENSE = 2**31
"""Voxels of a dense volume, 8 GB."""


def check_target(path: Path, suffixes: tuple[str, ...]) -> None:
    """Raise OcnfError unless a file of this name can be written: its suffix, and its folder."""
    if path.suffix.lower() not in suffixes:
        raise OcnfError("cannot be written in this format", where=path, found=path.suffix or "no suffix",
                        expected=", ".join(suffixes))
    check_file(path)


def check_picture(path: Path) -> None:
    """`check_target` for a PNG, and whether there is what draws it."""
    check_target(path, (".png",))
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise missing_extra("pictures need matplotlib", "fuse") from error


def check_dense(path: Path, shape: tuple[int, ...]) -> None:
    """Raise OcnfError where a grid (D, H, W) is too large for a file of this name: `.npz` is dense."""
    if path.suffix.lower() == ".npz" and np.prod(shape, dtype=float) > _MAX_DENSE:
        raise OcnfError("too large as a dense volume", code="too_large", where=path,
                        found=f"{shape} voxels", expected=f"at most {_MAX_DENSE:,}",
                        fix="write an octree, to a name that ends in .oc")


def mesh_suffixes() -> tuple[str, ...]:
    """The suffixes that meshes can be written with."""
    return tuple(WRITERS)


def save_tsdf(result: Reconstruction, path: Path) -> None:
    """Write the TSDF that a surface was cut out of.

    `.npz` is dense, float32: `tsdf` (D, H, W), TSDF / tau, axes z, y, x; `first` (x, y, z) of the centre of
    voxel 0, 0, 0, `voxel` and `truncation`, all in metres. `.oc` is the published format of octrees
    (`GridOctree.read_oc`), and beside it `.json` has the same three, and the shape.

    Raises:
        OcnfError: another suffix, a dense volume of more than 8 GB (`too_large`), or the file cannot be
            written.
    """
    check_target(path, TSDF_SUFFIXES)
    octree, store = result.octree, Store(path.parent)
    voxel = result.region.size / max(octree.shape)
    first = np.array(result.region.centre) - voxel * (np.array(octree.shape[::-1]) - 1) / 2
    if path.suffix.lower() == ".oc":
        with store.writing(path.name) as file:
            octree.write_oc(file)
        placing = {"shape": octree.shape, "first": first.tolist(), "voxel": voxel,
                   "truncation": result.truncation}
        store.put_bytes(path.with_suffix(".json").name, json.dumps(placing, indent=1).encode())
        return
    check_dense(path, octree.shape)
    with store.writing(path.name) as file, file.open("wb") as stream:
        np.savez_compressed(stream, tsdf=octree.to_dense()[0], first=first, voxel=voxel,
                            truncation=result.truncation)
