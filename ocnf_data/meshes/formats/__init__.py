"""Parsers from the bytes of a mesh file to vertices and triangles.

Each takes the whole file as bytes and opens nothing else (no material, texture or external buffer), checks
what the header claims against the bytes that are there before it allocates, and raises OcnfError for
everything else. OFF, OBJ, PLY and STL are read here, because trimesh 5.2 fails on OFF and binary PLY files
that mix triangles with larger polygons, counts negative OBJ indices from the end of the file instead of from
the face, splits and reorders the vertices of an OBJ at texture seams, allocates an object for every line of
an ASCII PLY, and accepts one whose header announces more than it holds (docs/decisions.md). GLB goes through
trimesh, behind a check of its accessors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from ocnf_data.arrays import F64, I64
from ocnf_data.meshes.formats.glb import parse_glb
from ocnf_data.meshes.formats.obj import parse_obj
from ocnf_data.meshes.formats.off import parse_off
from ocnf_data.meshes.formats.ply import parse_ply
from ocnf_data.meshes.formats.stl import parse_stl

Parser = Callable[[bytes, str, int], tuple[F64, I64]]


class Format(NamedTuple):
    """A mesh format: how its files end and how they are read."""

    suffix: str
    parse: Parser


FORMATS: dict[str, Format] = {
    f.suffix: f
    for f in (
        Format(".glb", parse_glb),
        Format(".obj", parse_obj),
        Format(".off", parse_off),
        Format(".ply", parse_ply),
        Format(".stl", parse_stl),
    )
}
