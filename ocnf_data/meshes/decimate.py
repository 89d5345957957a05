"""Fewer faces for a mesh."""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import missing_extra


def collapse_edges(vertices: F64, faces: I64, count: int, what: str, extra: str) -> tuple[F64, I64]:
    """A mesh with about `count` faces, by collapsing edges at the least quadric error (Garland and Heckbert,
    SIGGRAPH 1997).

    Args:
        vertices: (N, 3).
        faces: (M, 3), more than `count`.
        count: faces, at least 4.
        what: what needs the library, for the message where it is missing.
        extra: the extra that has it there.

    Raises:
        OcnfError: fast-simplification is not installed (`missing_extra`).
    """
    check_library(what, extra)
    from fast_simplification import simplify

    middle = vertices.mean(axis=0)  # it rounds to float32 on the way, in some of its versions
    points, triangles = simplify(vertices - middle, faces.astype(np.int32), target_count=count)[:2]
    return np.asarray(points, np.float64) + middle, np.asarray(triangles, np.int64)


def check_library(what: str, extra: str) -> None:
    """Raise OcnfError unless `collapse_edges` has what it needs; arguments as there."""
    try:
        import fast_simplification  # noqa: F401
    except ImportError as error:
        raise missing_extra(f"{what} needs fast-simplification", extra) from error
