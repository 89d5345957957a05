"""The files of a fused scan. Whether they can be written is found out before anything is fused."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.files.targets import check_file, check_target
from ocnf_data.meshes.writing import WRITERS, check_stl
from ocnf_model.scan.reconstruction import Reconstruction
from ocnf_model.scan.region import Region

TSDF_SUFFIXES = (".npz", ".oc")
_PLACING = {"shape", "first", "voxel", "truncation"}
_MAX_PLACING = 2**16  # bytes
_MAX_DENSE = 2**31
"""Voxels of a dense volume, 8 GB."""


def check_picture(path: Path) -> None:
    """Raise OcnfError unless a PNG of this name can be written and matplotlib, which draws it, is there."""
    check_target(path, (".png",))
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise missing_extra("pictures need matplotlib", "fuse") from error


def check_placing(path: Path) -> list[Path]:
    """The file that tells where a TSDF of this name lies, if it has one, once it can be written.

    Raises:
        OcnfError: it cannot, or there is another JSON file of that name.
    """
    if path.suffix.lower() != ".oc":
        return []
    beside = path.with_suffix(".json")
    check_file(beside)
    if beside.exists():
        with storage_errors(beside), beside.open("rb") as opened:
            text = opened.read(_MAX_PLACING)
        try:
            fields = json.loads(text)
        except ValueError:
            fields = None
        if not isinstance(fields, dict) or fields.keys() != _PLACING:
            raise OcnfError("another file lies where the octree's place would be written", where=beside,
                            fix="give --tsdf another name")
    return [beside]


def refuse_same(paths: Sequence[Path]) -> None:
    """Raise OcnfError where two files would have one name."""
    names = [path.resolve() for path in paths]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise OcnfError("two files would have the same name", where=paths[i],
                            fix="give each a name of its own")


def check_dense(path: Path, shape: tuple[int, ...]) -> None:
    """Raise OcnfError where a grid (D, H, W) is too large for a file of this name: `.npz` is dense."""
    if path.suffix.lower() == ".npz" and np.prod(shape, dtype=float) > _MAX_DENSE:
        raise OcnfError("too large as a dense volume", code="too_large", where=path,
                        found=f"{shape} voxels", expected=f"at most {_MAX_DENSE:,}",
                        fix="write an octree, to a name that ends in .oc")


def check_mesh(path: Path, region: Region, voxel: float) -> None:
    """Raise OcnfError where such a file cannot hold the mesh of a region, in voxels of so many metres."""
    if path.suffix.lower() == ".stl":
        check_stl(float(np.abs([region.low, region.high]).max()), voxel / 2)


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
