"""Which meshes a folder laid out as ModelNet holds: `root/category/folder/*.off`.

A link counts as the file it leads to, outside of the root too: data sets are often put together of links.
"""

from __future__ import annotations

import os
from pathlib import Path

from ocnf_data.errors import OcnfError
from ocnf_data.meshes.formats import FORMATS


def list_modelnet(root: str | os.PathLike[str], category: str, folder: str) -> list[str]:
    """Mesh files of `root/category/folder`, as POSIX paths relative to `root`, sorted as strings.

    Hidden files (see `list_hidden`) and other suffixes are passed over; folders in it are not entered.

    Raises:
        OcnfError: the folder is missing or cannot be read (`missing`), or holds no mesh (`empty`).
    """
    found = [path for path, hidden in _listed(root, category, folder) if not hidden]
    if not found:
        raise OcnfError("holds no mesh", code="empty", where=Path(root) / category / folder, field=category,
                        expected=", ".join(FORMATS))
    return found


def list_hidden(root: str | os.PathLike[str], category: str, folder: str) -> list[str]:
    """Like `list_modelnet`, what has a mesh's suffix there but a name that begins with a dot; may be []."""
    return [path for path, hidden in _listed(root, category, folder) if hidden]


def is_hidden(name: str) -> bool:
    """Whether a file's or a folder's name begins with a dot."""
    return name.startswith(".")


def _listed(root: str | os.PathLike[str], category: str, folder: str) -> list[tuple[str, bool]]:
    """(path, whether it is hidden) of all that has a mesh's suffix, sorted by path."""
    base = Path(root)
    place = base / category / folder
    try:
        names = [p.name for p in place.iterdir() if p.suffix.lower() in FORMATS]
    except OSError as error:
        there = sorted(p.name for p in base.iterdir() if p.is_dir()) if base.is_dir() else None
        raise OcnfError(f"cannot be listed ({error.strerror})", code="missing", where=place, field=category,
                        expected="a folder of meshes" if there is None else f"one of {', '.join(there)}",
                        fix="check the meshes' root folder and the category's name") from error
    return sorted((f"{category}/{folder}/{name}", is_hidden(name)) for name in names)
