"""An octree as bytes: the payload of every octree member of a shard.

A safetensors file in one zstd frame, which carries its content size and a checksum:

    8 bytes     uint64, little-endian: bytes of the header
    header      JSON, padded with spaces to a multiple of 8:
                {"__metadata__": {"ocnf": "..."}, "data": {...}, "trees": {...}}
    trees       (GD, GH, GW, 10) uint8: the 73 bits of each tree, bit i in byte i // 8, and 7 zero bits
    data        (n_leaves, C) uint8 or float16, little-endian: see `octree.stored`

The one metadata key `ocnf` holds canonical JSON (sorted keys, no blanks): version, kind, shape (D, H, W),
units, and `divisor`: value = data / divisor. The header's bytes follow from (kind, shape, n_leaves): decoding
compares all of them instead of trusting any, and equal octrees give equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zstandard

from ocnf_data.errors import OcnfError
from ocnf_data.octree.grid import MAX_RESOLUTION, GridOctree
from ocnf_data.octree.stored import STORAGE, RawOctree, quantise, storage_of

VERSION = 1
MAX_DECODED_BYTES = 1 << 30
"""Largest octree, in bytes before compression: decoding never allocates more for the frame's content."""

_LEVEL = 6  # docs/storage-table.md: level 9 saves 2 % more and takes twice as long
_MAX_HEADER = 1024
_TREE_BYTES = 10
_SAFETENSORS_DTYPE = {np.dtype(np.uint8): "U8", np.dtype(np.float16): "F16"}


def encode(octree: GridOctree, kind: str) -> bytes:
    """The bytes of an octree, rounded to the levels of its kind (an `Encoding` or "target").

    Raises:
        OcnfError: the octree has the wrong channels or values for its kind, or is too large.
    """
    return encode_raw(quantise(octree, kind))


def encode_raw(raw: RawOctree) -> bytes:
    """The bytes of an octree that is already in its stored form; equal octrees give equal bytes.

    Raises:
        OcnfError: more than `MAX_RESOLUTION` voxels along an axis, or more than `MAX_DECODED_BYTES` before
            compression (`too_large`).
    """
    header = _header(raw.kind, raw.shape, raw.n_leaves)
    words = raw.trees.astype("<u8", copy=False)
    content = b"".join((
        len(header).to_bytes(8, "little"),
        header,
        np.ascontiguousarray(words.view(np.uint8)[..., :_TREE_BYTES]).data,
        raw.data.astype(raw.data.dtype.newbyteorder("<"), copy=False).data,
    ))
    if max(raw.shape) > MAX_RESOLUTION or len(content) > MAX_DECODED_BYTES:
        raise OcnfError("too large to be stored", code="too_large", field=raw.kind,
                        found=f"{raw.shape} voxels, {len(content)} bytes",
                        expected=f"at most {MAX_RESOLUTION} along an axis and {MAX_DECODED_BYTES} bytes")
    compressor = zstandard.ZstdCompressor(level=_LEVEL, write_checksum=True, write_content_size=True)
    return compressor.compress(content)


def decode(blob: bytes, kind: str | None = None) -> GridOctree:
    """The octree in float32; see `decode_raw`."""
    return decode_raw(blob, kind).to_grid()


def decode_raw(blob: bytes, kind: str | None = None, resolution: int | None = None) -> RawOctree:
    """The octree in its stored dtype, read-only, checked in full.

    Args:
        blob: what `encode` returned; any bytes are safe.
        kind: the kind it has to be, None = any.
        resolution: voxels along each axis of the cube it has to be, None = any; so a few bytes that claim a
            large one do not take its memory.

    Raises:
        OcnfError: the bytes are damaged, are no octree, contradict themselves or are not what is asked for.
            Nothing else is raised, and memory stays within the content size, which is checked against the
            header's claims and `MAX_DECODED_BYTES` first.
    """
    raw_kind, shape, n_leaves, start = _read_header(blob)
    if kind is not None and raw_kind != kind:
        raise OcnfError("the octree is of another kind", field="kind", found=raw_kind, expected=str(kind))
    if resolution is not None and shape != (resolution,) * 3:
        raise OcnfError("the octree is of another resolution", code="structure", field="shape", found=shape,
                        expected=resolution)
    storage = storage_of(raw_kind)
    grid = (shape[0] // 8, shape[1] // 8, shape[2] // 8)
    n_trees = grid[0] * grid[1] * grid[2]
    end_of_trees = start + n_trees * _TREE_BYTES
    size = end_of_trees + n_leaves * storage.channels * storage.dtype.itemsize
    content = _decompress(blob, size)

    bits = np.frombuffer(content, np.uint8, end_of_trees - start, start)
    words = np.zeros((n_trees, 16), np.uint8)
    words[:, :_TREE_BYTES] = bits.reshape(n_trees, _TREE_BYTES)
    trees = words.view("<u8").astype(np.uint64, copy=False).reshape(*grid, 2)
    data = np.frombuffer(content, storage.dtype.newbyteorder("<"), n_leaves * storage.channels, end_of_trees)
    return RawOctree(trees, data.astype(storage.dtype, copy=False).reshape(n_leaves, -1), raw_kind)


def _header(kind: str, shape: tuple[int, int, int], n_leaves: int) -> bytes:
    """The safetensors header of an octree, padded."""
    storage = storage_of(kind)
    meta = {"divisor": storage.divisor, "kind": kind, "shape": list(shape), "units": storage.units,
            "version": VERSION}
    grid = [n // 8 for n in shape]
    n_tree_bytes = grid[0] * grid[1] * grid[2] * _TREE_BYTES
    n_data_bytes = n_leaves * storage.channels * storage.dtype.itemsize
    text = _canonical({
        "__metadata__": {"ocnf": _canonical(meta)},
        "trees": {"dtype": "U8", "shape": [*grid, _TREE_BYTES], "data_offsets": [0, n_tree_bytes]},
        "data": {"dtype": _SAFETENSORS_DTYPE[storage.dtype], "shape": [n_leaves, storage.channels],
                 "data_offsets": [n_tree_bytes, n_tree_bytes + n_data_bytes]},
    }).encode("ascii")
    return text + b" " * (-len(text) % 8)


def _canonical(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"), sort_keys=True)


def _read_header(blob: bytes) -> tuple[str, tuple[int, int, int], int, int]:
    """(kind, shape, n_leaves, offset of the tensors), from the first kilobyte of the frame's content."""
    with _our_error():
        head = zstandard.ZstdDecompressor().stream_reader(blob).read(8 + _MAX_HEADER)
    length = int.from_bytes(head[:8], "little")
    if len(head) < 8 or length > _MAX_HEADER or len(head) < 8 + length:
        raise OcnfError("the header is too long or cut off", code="header", found=f"{length} bytes",
                        expected=f"at most {_MAX_HEADER}")
    text = head[8 : 8 + length]
    try:
        header = json.loads(text)
        meta = json.loads(header["__metadata__"]["ocnf"])
        kind, shape, n_leaves = meta["kind"], meta["shape"], header["data"]["shape"][0]
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise OcnfError("the header is not that of an octree", code="header", found=text) from error
    if meta.get("version") != VERSION:
        raise OcnfError("written by another version of the format", code="version", field="version",
                        found=meta.get("version"), expected=VERSION)
    if not isinstance(kind, str) or kind not in STORAGE:
        raise OcnfError("not a kind of octree", code="header", field="kind", found=kind,
                        expected=", ".join(STORAGE))
    if not (isinstance(shape, list) and len(shape) == 3 and all(_is_resolution(n) for n in shape)):
        raise OcnfError("not the shape of a volume", code="header", field="shape", found=shape,
                        expected=f"three multiples of 8, at most {MAX_RESOLUTION}")
    if type(n_leaves) is not int or not 0 < n_leaves <= shape[0] * shape[1] * shape[2]:
        raise OcnfError("not a number of leaves", code="header", field="data.shape", found=n_leaves,
                        expected=f"1 to {shape[0] * shape[1] * shape[2]}")
    dims = (shape[0], shape[1], shape[2])
    expected = _header(kind, dims, n_leaves)
    if text != expected:
        raise OcnfError("the header contradicts itself", code="header", found=text, expected=expected)
    return kind, dims, n_leaves, 8 + length


def _is_resolution(n: object) -> bool:
    return type(n) is int and 8 <= n <= MAX_RESOLUTION and n % 8 == 0


def _decompress(blob: bytes, size: int) -> bytes:
    """The content of the one frame, which has to be `size` bytes; its checksum is verified."""
    with _our_error():
        frame = zstandard.get_frame_parameters(blob)
        if not frame.has_checksum:
            raise OcnfError("the frame has no checksum", code="checksum")
        if frame.content_size != size or size > MAX_DECODED_BYTES:
            raise OcnfError("the frame is not of the size that its header claims", code="too_large",
                            found=f"{frame.content_size} bytes",
                            expected=f"{size}, at most {MAX_DECODED_BYTES}")
        return zstandard.ZstdDecompressor().decompress(blob, allow_extra_data=False)


@contextmanager
def _our_error() -> Iterator[None]:
    try:
        yield
    except zstandard.ZstdError as error:
        raise OcnfError(f"the zstd frame is damaged: {error}", code="checksum") from error
