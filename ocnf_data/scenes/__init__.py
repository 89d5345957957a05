"""Procedural scenes: furnished rooms, and tables with things on them, out of `ocnf_data.shapes`.

z is up, the floor or the table's top is z = 0, and lengths are metres of about their real size. Things stand
on what carries them and do not intersect: their boxes keep apart. A scene is a pure function of (seed, kind,
split, index), like a shape.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.meshes.read import Mesh
from ocnf_data.meshes.topology import mesh_stats
from ocnf_data.scenes.place import Draft
from ocnf_data.scenes.rooms import room
from ocnf_data.scenes.tabletops import tabletop
from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.primitives import join

_BUILDERS: dict[str, Callable[[Draw, Draft], Draft]] = {"rooms": room, "tabletops": tabletop}
SCENES: tuple[str, ...] = tuple(_BUILDERS)


def make_scene(kind: str, seed: int, index: int, split: str) -> Mesh:
    """The scene of that number, e.g. `make_scene("rooms", seed=0, index=12, split="train")`.

    Vertices are rounded to a micrometre; `sha256` is that of the vertices' and then the faces' bytes.

    Raises:
        OcnfError: a kind that is not in SCENES.
    """
    return scene_mesh(draft_scene(kind, seed, index, split))


def scene_mesh(draft: Draft) -> Mesh:
    """The mesh of a scene's things, as `make_scene` has it."""
    part = join([part for part, _ in draft.parts])
    vertices = np.round(part.vertices, 6) + 0.0  # no negative zeros
    faces = np.ascontiguousarray(part.faces, dtype=np.int64)
    sha256 = hashlib.sha256(vertices.astype("<f8").tobytes() + faces.astype("<i8").tobytes()).hexdigest()
    return Mesh(vertices, faces, sha256, mesh_stats(vertices, faces))


def draft_scene(kind: str, seed: int, index: int, split: str) -> Draft:
    """The things of a scene one by one, in metres; `make_scene` joins them.

    Raises:
        OcnfError: a kind that is not in SCENES.
    """
    if kind not in _BUILDERS:
        raise OcnfError("no such kind of scene", field="kind", found=kind, expected=", ".join(SCENES))
    return _BUILDERS[kind](Draw("ocnf.scenes.1", seed, kind, split, index), Draft(seed, split))
