"""Items that are no files: procedural shapes and scenes, and what they are called."""

from __future__ import annotations

from ocnf_data.meshes import Mesh
from ocnf_data.scenes import SCENES, make_scene
from ocnf_data.shapes import make_shape

_SHAPES, _SCENES = "shapes:", "scenes:"


def procedural_name(category: str, split: str, index: int) -> str:
    """An item's source: `shapes:chair:train:3`, `scenes:rooms:train:3`."""
    return f"{_SCENES if category in SCENES else _SHAPES}{category}:{split}:{index}"


def is_procedural(source: str) -> bool:
    """Whether a source is such a name, and not a file's."""
    return source.startswith((_SHAPES, _SCENES))


def make_procedural(category: str, seed: int, index: int, split: str) -> Mesh:
    """The shape or the scene."""
    return (make_scene if category in SCENES else make_shape)(category, seed, index, split)
