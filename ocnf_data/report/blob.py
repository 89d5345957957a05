"""Arrays of one sample as one compressed string, which the page's script unpacks (`assets/blob.js`).

    uint32 little-endian: bytes of the header
    header: JSON, {"meta": anything, "arrays": {name: [dtype, shape, offset in the body, coding]}}
    body: the arrays, C order, little-endian

All of it is deflated (zlib) and written in base64. Coding `delta` holds differences along the first axis,
wrapped around, and then the bytes of all numbers by significance: marching cubes lists vertices and faces in
the order of the volume, so that most of these bytes are 0 or repeat, and deflate halves them.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

_UNSIGNED = {"uint8": np.uint8, "uint16": np.uint16, "uint32": np.uint32}


def pack(arrays: Mapping[str, npt.NDArray[Any]], meta: object) -> str:
    """The string of some arrays of uint8, uint16 or uint32, and of what JSON can hold beside them.

    One-dimensional uint8 arrays go as they are: they are pictures, compressed already, or single colours.

    Raises:
        TypeError: an array of another type, or something in `meta` that JSON cannot hold.
        ValueError: a number in `meta` that is not finite.
    """
    header: dict[str, list[Any]] = {}
    body = bytearray()
    for name, array in arrays.items():
        kind = array.dtype.name
        if kind not in _UNSIGNED:
            raise TypeError(f"{name}: {kind} is not packed")
        is_plain = array.ndim == 1 and kind == "uint8"
        header[name] = [kind, list(array.shape), len(body), "plain" if is_plain else "delta"]
        body += array.tobytes() if is_plain else _delta(array)
    text = json.dumps({"meta": meta, "arrays": header}, separators=(",", ":"), allow_nan=False).encode()
    raw = len(text).to_bytes(4, "little") + text + bytes(body)
    return base64.b64encode(zlib.compress(raw, 7)).decode("ascii")


def unpack(text: str) -> tuple[dict[str, npt.NDArray[Any]], Any]:
    """The arrays and the rest that `pack` was given."""
    raw = zlib.decompress(base64.b64decode(text))
    end = 4 + int.from_bytes(raw[:4], "little")
    header = json.loads(raw[4:end])
    arrays = {}
    for name, (kind, shape, offset, coding) in header["arrays"].items():
        dtype = np.dtype(kind)
        n = int(np.prod(shape))
        part = np.frombuffer(raw, np.uint8, n * dtype.itemsize, end + offset)
        if coding == "plain":
            arrays[name] = part.reshape(shape)
            continue
        numbers = np.ascontiguousarray(part.reshape(dtype.itemsize, n).T).view(dtype.newbyteorder("<"))
        arrays[name] = np.cumsum(numbers.reshape(shape), axis=0, dtype=dtype)
    return arrays, header["meta"]


def _delta(array: npt.NDArray[Any]) -> bytes:
    """Differences along the first axis modulo the type's range, then byte planes, the lowest first."""
    steps = np.diff(array, axis=0, prepend=array.dtype.type(0))
    little = np.ascontiguousarray(steps.astype(array.dtype.newbyteorder("<")))
    return np.ascontiguousarray(little.reshape(-1, 1).view(np.uint8).T).tobytes()
