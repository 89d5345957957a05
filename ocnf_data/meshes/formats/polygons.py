"""What the parsers share: numbers out of text, triangles out of polygons, indices that are checked."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt
from numba import njit

from ocnf_data.arrays import I32, I64, U8
from ocnf_data.errors import OcnfError

_COMMENT = re.compile(rb"(?<![^\s])#[^\n]*")  # not within a word: `1.#INF` is a number that is not finite
_NEWLINE = ord("\n")


def unreadable(what: str, where: str, found: object = None, expected: object = None) -> OcnfError:
    """The error for a file that is not what its name says."""
    return OcnfError(what, code="unreadable", where=where, found=found, expected=expected)


def check_face_count(n_faces: int, max_faces: int, where: str) -> None:
    """Raise `too_large` for more than `max_faces` faces."""
    if n_faces > max_faces:
        raise OcnfError("too many faces", code="too_large", where=where, found=n_faces,
                        expected=f"at most {max_faces}", fix="simplify the mesh or raise the limit")


def plain_text(data: bytes) -> bytes:
    """`data` with line ends as newlines, one at the end, without byte-order mark and `#` comments."""
    text = data.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in text:
        text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"#" in text:
        text = _COMMENT.sub(b"", text)
    return text + b"\n"


@njit(inline="always")
def is_blank(byte: int) -> bool:
    """Whether a byte separates tokens; the control characters are no part of any number."""
    return byte <= 32


@njit(cache=True, nogil=True)
def _tokens_per_line(text: U8) -> I32:
    """(lines,) how many tokens stand on each line."""
    n_lines = 0
    for byte in text:
        n_lines += byte == _NEWLINE
    counts = np.zeros(n_lines, np.int32)
    line, before = 0, True
    for byte in text:
        blank = is_blank(byte)
        if before and not blank:
            counts[line] += 1
        line += byte == _NEWLINE
        before = blank
    return counts


def parse_numbers(text: U8, where: str, dtype: type) -> tuple[npt.NDArray, I64]:
    """All numbers of a text of which every line ends in a newline.

    Returns:
        values (n,) of `dtype`, and counts (lines,): how many of them stand on each line, blank ones too.

    Raises:
        OcnfError: something in it is not a number of that kind (`unreadable`).
    """
    counts = _tokens_per_line(text).astype(np.int64)
    if not counts.any():  # numpy reads a number out of pure white space
        return np.empty(0, dtype), counts
    values: npt.NDArray
    try:
        values = np.fromstring(text.tobytes(), dtype=dtype, sep=" ")
    except ValueError:
        values = np.empty(0, dtype)
    if values.size != counts.sum():
        raise unreadable("holds something that is not a number", where)
    return values, counts


def fan(corners: npt.NDArray, first: I64, n_corners: I64) -> npt.NDArray:
    """Triangles (M, 3) of polygons, each fanned from its first corner.

    Args:
        corners: (n,) vertex indices.
        first: (P,) position in `corners` of each polygon's first.
        n_corners: (P,) corners a polygon; those under 3 give no triangle.
    """
    n_triangles = np.maximum(n_corners - 2, 0)
    if (n_corners == 3).all():
        return corners[first[:, None] + np.arange(3)]
    apex = np.repeat(first, n_triangles)
    k = np.arange(apex.size) - np.repeat(np.cumsum(n_triangles) - n_triangles, n_triangles)
    return corners[np.stack([apex, apex + k + 1, apex + k + 2], axis=1)]


def check_indices(faces: npt.NDArray, n_vertices: int, where: str) -> I64:
    """`faces` (M, 3) as int64; OcnfError (`unreadable`) for an index that is no vertex."""
    bad = ~((faces >= 0) & (faces < n_vertices))
    if faces.dtype.kind == "f":
        bad |= faces != np.floor(faces)
    if bad.any():
        raise unreadable("a face has an index that is no vertex", where, found=faces[bad][0],
                         expected=f"0 to {n_vertices - 1}")
    return faces.astype(np.int64)
