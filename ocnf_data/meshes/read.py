"""Meshes: read from a file, checked and measured (SEMANTICS 1)."""

from __future__ import annotations

import hashlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError
from ocnf_data.meshes.formats import FORMATS
from ocnf_data.meshes.formats.polygons import check_face_count
from ocnf_data.meshes.topology import MeshStats, bounding_box, mesh_stats

MAX_MESH_BYTES = 256 * 2**20
MAX_FACES = 5_000_000


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh whose every index is a vertex and whose every coordinate is finite.

    Attributes:
        vertices: (N, 3) float64, in the units and order of the source.
        faces: (M, 3) int64.
        sha256: hex digest of the file's bytes, or of the arrays of a procedural shape.
        stats: counts, watertightness and components.
    """

    vertices: F64
    faces: I64
    sha256: str
    stats: MeshStats


def read_mesh(path: str | os.PathLike[str], max_bytes: int = MAX_MESH_BYTES,
              max_faces: int = MAX_FACES) -> Mesh:
    """Read an OFF, OBJ, PLY, STL or GLB file; polygons become fans of triangles.

    The file is read once, so that the checksum is that of the bytes that were parsed, and no other file is
    opened. Inconsistent winding, holes, unreferenced vertices and faces without area are kept as they are.

    Raises:
        OcnfError: with the code `unreadable` (missing, no permission, not a plain file, not the format it
            claims, an index out of range), `empty` (no faces), `non_finite` (a NaN or infinite coordinate),
            `degenerate` (no extent, or no face with an area) or `too_large` (bytes or faces).
    """
    path = Path(path)
    where = str(path)
    form = FORMATS.get(path.suffix.lower())
    if form is None:
        raise OcnfError("not a known mesh format", code="unreadable", where=where,
                        found=path.suffix or "no suffix", expected=", ".join(FORMATS))
    data = _read_bytes(path, max_bytes)
    if not data.strip():
        raise OcnfError("the file is empty", code="empty", where=where)
    try:
        vertices, faces = form.parse(data, where, max_faces)
    except MemoryError as error:
        raise OcnfError("does not fit into memory", code="too_large", where=where) from error
    sha256 = hashlib.sha256(data).hexdigest()
    check_face_count(len(faces), max_faces, where)
    if len(faces) == 0:
        raise OcnfError("has no faces", code="empty", where=where, found=f"{len(vertices)} vertices")
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise OcnfError("a vertex is not finite", code="non_finite", where=where, field=f"vertex {bad}",
                        found=vertices[bad].tolist())
    bounding_box(vertices, faces, where)
    with np.errstate(over="ignore", invalid="ignore"):
        stats = mesh_stats(vertices, faces)
    if stats["degenerate_faces"] == len(faces):
        raise OcnfError("no face has an area", code="degenerate", where=where, found=f"{len(faces)} faces")
    return Mesh(np.ascontiguousarray(vertices), np.ascontiguousarray(faces), sha256, stats)


def _read_bytes(path: Path, max_bytes: int) -> bytes:
    try:
        # Looked at before it is opened: opening a pipe would wait for its writer for ever.
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise OcnfError("not a plain file", code="unreadable", where=path)
        if status.st_size > max_bytes:
            raise OcnfError("the file is too large", code="too_large", where=path,
                            found=f"{status.st_size} bytes", expected=f"at most {max_bytes}",
                            fix="raise the limit if the file is meant")
        with path.open("rb") as file:
            return file.read(status.st_size)
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise OcnfError(f"cannot be read ({reason})", code="unreadable", where=path) from error
