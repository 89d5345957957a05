"""The published `.oc` file format, read and written; little-endian throughout.

    bytes   content
    28      int32: 31193, n, grid depth GD, grid height GH, grid width GW, channels C, leaves L
    16 B    trees: 4 int32 a block, 128 bits of which 73 are used; block (gd*GH + gh)*GW + gw
    4 L C   data: float32, channel fastest, leaves in block order and inside a block in leaf order
    4 B     prefix_leafs: int32, the number of leaves in all blocks before this one

with B = GD GH GW blocks. The format knows batches of n grids; this project stores one octree a file, n = 1.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from ocnf_data.errors import OcnfError

if TYPE_CHECKING:  # grid.py imports this module
    from ocnf_data.arrays import F32, U64
    from ocnf_data.octree.grid import GridOctree

_MAGIC = 31193
_HEADER = ("magic", "n", "grid_depth", "grid_height", "grid_width", "channels", "n_leafs")
_HEADER_BYTES = 4 * len(_HEADER)
_TREE_MASK = np.array([0xFFFFFFFFFFFFFFFF, 0x1FF], "<u8")  # 73 bits


def write_oc(octree: GridOctree, path: str | os.PathLike[str]) -> None:
    """Write one octree as a `.oc` file.

    Raises:
        OcnfError: a count does not fit the format's int32, or the file cannot be written.
    """
    header = [_MAGIC, 1, *octree.trees.shape[:3], octree.channels, octree.n_leaves]
    if max(header) > np.iinfo(np.int32).max:
        raise OcnfError("too large for the format's 32-bit counts", where=path, field="n_leafs",
                        found=octree.n_leaves)
    try:
        with Path(path).open("wb") as file:
            file.write(np.array(header, "<i4").tobytes())
            file.write(octree.trees.astype("<u8", copy=False).data)
            file.write(octree.data.astype("<f4", copy=False).data)
            file.write(octree.prefix[:-1].astype("<i4").data)
    except OSError as error:
        raise OcnfError(f"cannot be written: {error.strerror}", code="unwritable", where=path) from error


def read_oc(path: str | os.PathLike[str], make: Callable[[U64, F32], GridOctree]) -> GridOctree:
    """Read a `.oc` file. Nothing is allocated before the header agrees with the size of the file.

    Args:
        path: path of the file.
        make: an octree of trees and data: the class.

    Raises:
        OcnfError: the file cannot be read, holds more than one octree, or contradicts itself anywhere.
    """
    try:
        with Path(path).open("rb") as file:
            return _read(file, path, make)
    except OSError as error:
        raise OcnfError(f"cannot be read: {error.strerror}", code="unreadable", where=path) from error


def _read(file: BinaryIO, path: str | os.PathLike[str], make: Callable[[U64, F32], GridOctree]) -> GridOctree:
    size = os.fstat(file.fileno()).st_size
    raw = file.read(_HEADER_BYTES)
    if len(raw) < _HEADER_BYTES:
        raise OcnfError("too short for a .oc header", code="truncated", where=path, found=f"{len(raw)} bytes",
                        expected=f"{_HEADER_BYTES} or more")
    header = dict(zip(_HEADER, np.frombuffer(raw, "<i4").tolist(), strict=True))
    if header["magic"] != _MAGIC:
        raise OcnfError("not a .oc file", where=path, field="magic", found=header["magic"], expected=_MAGIC)
    if header["n"] != 1:
        raise OcnfError("holds a batch; only files with one octree are read", where=path, field="n",
                        found=header["n"], expected=1)
    for field in _HEADER[2:]:
        if header[field] < 1:
            raise OcnfError("not a size", where=path, field=field, found=header[field], expected="1 or more")

    grid = (header["grid_depth"], header["grid_height"], header["grid_width"])
    n_blocks, n_leaves, channels = grid[0] * grid[1] * grid[2], header["n_leafs"], header["channels"]
    expected = _HEADER_BYTES + 16 * n_blocks + 4 * n_leaves * channels + 4 * n_blocks
    if size != expected:
        raise OcnfError("the header does not fit the size of the file", code="truncated", where=path,
                        found=f"{size} bytes", expected=f"{expected} bytes for {header}")
    body = file.read(expected - _HEADER_BYTES)
    if len(body) != expected - _HEADER_BYTES:
        raise OcnfError("the file ended while it was read", code="truncated", where=path)

    words = np.frombuffer(body, "<u8", 2 * n_blocks).reshape(*grid, 2) & _TREE_MASK
    data = np.frombuffer(body, "<f4", n_leaves * channels, 16 * n_blocks).reshape(n_leaves, channels)
    prefix = np.frombuffer(body, "<i4", n_blocks, 16 * n_blocks + 4 * n_leaves * channels)
    try:
        octree = make(words.astype(np.uint64, copy=False), data.astype(np.float32))
    except OcnfError as error:
        raise OcnfError(error.what, code=error.code, where=path, field=error.field, found=error.found,
                        expected=error.expected) from error
    wrong = np.flatnonzero(octree.prefix[:-1] != prefix)
    if wrong.size:
        raise OcnfError("is not the sum of the leaves before it", code="structure", where=path,
                        field=f"prefix_leafs[{wrong[0]}]", found=prefix[wrong[0]],
                        expected=octree.prefix[wrong[0]])
    return octree
