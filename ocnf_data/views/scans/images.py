"""Depth and colour images of scans: PNG, PGM, PPM, JPEG and NPY.

An image says how large it is before it is decoded, and is refused if that is more than a camera has: a PNG of
a few kilobytes can stand for gigabytes.
"""

from __future__ import annotations

import io
import re
import tokenize
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import U8
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.storage_errors import storage_errors

_MAX_FILE = 2**27  # bytes
_MAX_PIXELS = 2**26
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # the markers that hold the image's size
# What numpy raises on damaged headers, which are Python literals.
_NPY_ERRORS = (ValueError, TypeError, KeyError, SyntaxError, EOFError, OSError, RecursionError, MemoryError,
               tokenize.TokenError)
_PNM = re.compile(rb"P([56])" + rb"(?:\s+|#[^\n]*\n)+(\d{1,9})" * 3 + rb"\s")


def read_depth(file: Path) -> npt.NDArray[Any]:
    """A depth map (H, W) as it is stored: uint16 of a PNG or PGM, float or integer of an NPY.

    Raises:
        OcnfError: missing, of an impossible size (`too_large`), cut off or damaged (`damaged`), 8 bits, in
            colour.
    """
    data = _read(file)
    _size(file, data)
    if file.suffix.lower() == ".npy":
        image = _npy(file, data)
    elif data.startswith(b"P5"):
        image = _pgm(file, data)
    else:
        image = _decode(file, data, colour=False)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    plain = image.dtype == np.uint16 or (file.suffix.lower() == ".npy" and image.dtype.kind in "fui")
    if not plain or image.ndim != 2:
        raise OcnfError("not a depth map", where=file, found=f"{image.dtype} {image.shape}",
                        expected="one channel of 16 bits, or an NPY (H, W) of numbers")
    return np.ascontiguousarray(image)


def read_colour(file: Path) -> U8:
    """A colour image (H, W, 3), red, green, blue, 0 to 255, as its pixels are stored: EXIF turns nothing.

    Raises:
        OcnfError: missing, of an impossible size, or damaged.
    """
    data = _read(file)
    _size(file, data)
    return np.ascontiguousarray(_decode(file, data, colour=True)[:, :, ::-1])


def image_size(file: Path) -> tuple[int, int]:
    """(H, W) of an image file, from its header.

    Raises:
        OcnfError: missing, not an image of a known kind, of an impossible size.
    """
    begin = _read(file, 2**16)
    try:
        return _size(file, begin)
    except OcnfError:
        if len(begin) < 2**16 or not begin.startswith(b"\xff\xd8"):
            raise
    return _size(file, _read(file))  # a JPEG may have long profiles before it


def _read(file: Path, limit: int = _MAX_FILE) -> bytes:
    with storage_errors(file), file.open("rb") as opened:
        return opened.read(limit)


def _size(file: Path, data: bytes) -> tuple[int, int]:
    if file.suffix.lower() == ".npy":
        height, width = _npy_size(file, data)
    elif data.startswith(_PNG):
        width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    elif match := _PNM.match(data):
        width, height = int(match[2]), int(match[3])
    elif data.startswith(b"\xff\xd8"):
        height, width = _jpeg_size(file, data)
    else:
        kind = "PNG" if file.suffix.lower() == ".png" else "known image"
        raise OcnfError(f"not a {kind}", code="unreadable", where=file, found=data[:8],
                        expected="PNG, PGM, PPM, JPEG or NPY")
    if not 0 < width * height <= _MAX_PIXELS:
        raise OcnfError("impossible size of image", code="too_large", where=file, found=f"{width}x{height}",
                        expected=f"at most {_MAX_PIXELS} pixels")
    return height, width


def _npy_size(file: Path, data: bytes) -> tuple[int, int]:
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else (
            np.lib.format.read_array_header_2_0)
        shape, _, dtype = read(stream)
        if dtype.hasobject:
            raise ValueError("objects")
        if len(shape) not in (2, 3):
            raise ValueError(f"{shape}")
    except _NPY_ERRORS as error:
        raise OcnfError("not a readable NPY of numbers (H, W)", code="damaged", where=file,
                        found=str(error)) from error
    return int(shape[0]), int(shape[1])


def _jpeg_size(file: Path, data: bytes) -> tuple[int, int]:
    """(H, W) from the first frame header. A JPEG is markers FF xx, most followed by a length (big-endian)."""
    at = 2
    while at + 9 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _JPEG_SIZES:
            return int.from_bytes(data[at + 5 : at + 7], "big"), int.from_bytes(data[at + 7 : at + 9], "big")
        at += 2 if marker == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise OcnfError("the JPEG is cut off or damaged", code="damaged", where=file)


def _npy(file: Path, data: bytes) -> npt.NDArray[Any]:
    try:
        return np.asarray(np.load(io.BytesIO(data), allow_pickle=False))
    except _NPY_ERRORS as error:
        raise OcnfError("the NPY is cut off or damaged", code="damaged", where=file) from error


def _pgm(file: Path, data: bytes) -> npt.NDArray[Any]:
    """The numbers as they are stored; OpenCV would scale those whose maximum is not 255 or 65535."""
    match = _PNM.match(data)
    assert match is not None  # `_size` has seen it
    width, height, most = (int(match[i]) for i in (2, 3, 4))
    kind = np.dtype(np.uint8 if most < 256 else ">u2")
    if len(data) < match.end() + width * height * kind.itemsize:
        raise OcnfError("the PGM is cut off", code="damaged", where=file)
    return np.frombuffer(data, kind, width * height, match.end()).reshape(height, width).astype(
        kind.newbyteorder("="))


def _decode(file: Path, data: bytes, colour: bool) -> npt.NDArray[Any]:
    try:
        import cv2
    except ImportError as error:
        raise missing_extra("reading images needs OpenCV", "fuse") from error
    if data.startswith(_PNG):
        _check_png(file, data)
    try:
        # Pixels stay where the intrinsics mean them: OpenCV turns colour by its EXIF orientation unless told.
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION if colour else cv2.IMREAD_UNCHANGED
        image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise OcnfError("not a readable image", code="damaged", where=file) from error
    if image is None:
        raise OcnfError("not a readable image", code="damaged", where=file)
    return np.asarray(image)


def _check_png(file: Path, data: bytes) -> None:
    """Refuse what OpenCV would decode in part without a word.

    A PNG is a signature and chunks: length, name, content, CRC-32 of name and content; IEND is the last.
    """
    at, name = len(_PNG), b""
    while name != b"IEND":
        length = int.from_bytes(data[at : at + 4], "big")
        name, end = data[at + 4 : at + 8], at + 8 + length
        crc = int.from_bytes(data[end : end + 4], "big")
        if len(data) < end + 4 or zlib.crc32(data[at + 4 : end]) != crc:
            raise OcnfError("the PNG is cut off or damaged", code="damaged", where=file)
        at = end + 4
