"""Items that are no files: what procedural shapes and scenes and the configurations of scans are called."""

from __future__ import annotations

import re

from ocnf_data.meshes import Mesh
from ocnf_data.scenes import SCENES, make_scene
from ocnf_data.shapes import make_shape

_PROCEDURAL = re.compile(r"(shapes|scenes):[^:/]+:(train|val|test):\d+")
_SHAPES, _SCENES, _SEQUENCE = "shapes:", "scenes:", "sequence:"


def procedural_name(category: str, split: str, index: int) -> str:
    """An item's source: `shapes:chair:train:3`, `scenes:rooms:train:3`."""
    return f"{_SCENES if category in SCENES else _SHAPES}{category}:{split}:{index}"


def is_procedural(source: str) -> bool:
    """Whether a source is such a name, and not a file's."""
    return _PROCEDURAL.fullmatch(source) is not None


def is_scene(source: str) -> bool:
    """Whether a source is the name of a scene."""
    return is_procedural(source) and source.startswith(_SCENES)


def make_procedural(category: str, seed: int, index: int, split: str) -> Mesh:
    """The shape or the scene."""
    return (make_scene if category in SCENES else make_shape)(category, seed, index, split)


def configuration_name(path: str, index: int) -> str:
    """The source of an item that is a configuration of a scan: `sequence:kitchen:3`."""
    return f"{_SEQUENCE}{path}:{index}"


def scan_of_configuration(source: str) -> str:
    """The path of the scan in such a name."""
    return source.removeprefix(_SEQUENCE).rpartition(":")[0]


def is_configuration(source: str) -> bool:
    """Whether a source is such a name."""
    return source.startswith(_SEQUENCE)
