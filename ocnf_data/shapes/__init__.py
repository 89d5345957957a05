"""Procedural shapes: furniture, vessels, vehicles, frames, solids without end, as messy as downloaded meshes.

Everything stands on z = 0 with z up and faces the viewer at negative y, in metres of about its real size.
As in real collections there are thin bars and sheets without thickness, concave and hollow parts, solids
that overlap, things hidden inside others, and faces of inconsistent winding. A shape is a pure function of
(seed, category, split, index): it depends on no other shape, so counts can be raised later.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.meshes.read import Mesh
from ocnf_data.meshes.topology import is_watertight, mesh_stats
from ocnf_data.shapes.airplanes import airplane
from ocnf_data.shapes.beds import bed
from ocnf_data.shapes.cars import car
from ocnf_data.shapes.containers import basket, bathtub, bucket, open_box, pot
from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.guitars import guitar
from ocnf_data.shapes.lamps import lamp
from ocnf_data.shapes.monitors import monitor
from ocnf_data.shapes.plants import plant
from ocnf_data.shapes.primitives import Part, join, subdivide
from ocnf_data.shapes.rings import knot, pipe, ring, wheel
from ocnf_data.shapes.rods import fence, ladder, pole, rack, stool
from ocnf_data.shapes.seating import chair, sofa
from ocnf_data.shapes.shelves import shelf
from ocnf_data.shapes.solids import ball, block, boulder
from ocnf_data.shapes.tables import desk, table
from ocnf_data.shapes.tableware import bowl, cup, glass, pitcher, vase
from ocnf_data.shapes.vessels import bottle, mug

_BUILDERS: dict[str, Callable[[Draw], list[Part]]] = {
    "airplane": airplane, "ball": ball, "basket": basket, "bathtub": bathtub, "bed": bed, "block": block,
    "bottle": bottle, "boulder": boulder, "bowl": bowl, "box": open_box, "bucket": bucket, "car": car,
    "chair": chair, "cup": cup, "desk": desk, "fence": fence, "glass": glass, "guitar": guitar,
    "knot": knot, "ladder": ladder, "lamp": lamp, "monitor": monitor, "mug": mug, "pipe": pipe,
    "pitcher": pitcher, "plant": plant, "pole": pole, "pot": pot, "rack": rack, "ring": ring,
    "shelf": shelf, "sofa": sofa, "stool": stool, "table": table, "vase": vase, "wheel": wheel,
}  # fmt: skip
CATEGORIES: tuple[str, ...] = tuple(_BUILDERS)

_MIN_FACES = 100


def make_shape(category: str, seed: int, index: int, split: str) -> Mesh:
    """The shape of that number, e.g. `make_shape("chair", seed=0, index=12, split="train")`.

    Vertices are rounded to a micrometre, so that processors whose sines differ in the last bit still give
    the same bytes; `sha256` is that of the vertices' and then the faces' little-endian bytes.

    Raises:
        OcnfError: a category that is not in CATEGORIES.
    """
    if category not in _BUILDERS:
        raise OcnfError(
            "no such procedural shape",
            code="invalid",
            field="category",
            found=category,
            expected=", ".join(CATEGORIES),
        )
    draw = Draw("ocnf.shapes.1", seed, category, split, index)
    parts = _BUILDERS[category](draw)
    part = _rewind([*parts, *_cores(parts, draw)], draw)
    while len(part.faces) < _MIN_FACES:
        part = subdivide(part)
    vertices = np.round(part.vertices, 6) + 0.0  # no negative zeros
    faces = np.ascontiguousarray(part.faces, dtype=np.int64)
    sha256 = hashlib.sha256(vertices.astype("<f8").tobytes() + faces.astype("<i8").tobytes()).hexdigest()
    return Mesh(vertices, faces, sha256, mesh_stats(vertices, faces))


def _cores(parts: list[Part], draw: Draw) -> list[Part]:
    """Shells within solids, where no camera sees them: smaller copies of some convex parts inside these."""
    chosen = [draw.pick(*parts) for _ in range(draw.count(0, 6))]
    return [p.shrink(draw.between(0.3, 0.8)) for p in chosen if _is_convex(p)]


def _is_convex(part: Part) -> bool:
    """Whether a part is closed, convex, wound outwards, and small enough to be worth the test."""
    if len(part.faces) > 1500 or not is_watertight(part.faces):
        return False
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    height = part.vertices @ normal.T - (a * normal).sum(axis=1)
    return bool((height <= 1e-9 * np.ptp(part.vertices) ** 3).all())


def _rewind(parts: list[Part], draw: Draw) -> Part:
    """Join the parts; in most shapes some parts are inside out, and a share of single faces as well."""
    if draw.chance(0.15):
        return join(parts)
    inside_out = draw.flags(len(parts), 0.25)
    whole = join(
        [Part(p.vertices, p.faces[:, ::-1]) if flip else p for p, flip in zip(parts, inside_out, strict=True)]
    )
    flip = draw.flags(len(whole.faces), draw.between(0.02, 0.4))
    return Part(whole.vertices, np.where(flip[:, None], whole.faces[:, ::-1], whole.faces))
