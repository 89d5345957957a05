"""Which meshes a folder laid out as ModelNet holds: `root/category/folder/*.off`."""

from __future__ import annotations

import os
from pathlib import Path

from ocnf_data.errors import OcnfError
from ocnf_data.meshes.formats import FORMATS


def list_modelnet(root: str | os.PathLike[str], category: str, folder: str) -> list[str]:
    """Mesh files of `root/category/folder`, as POSIX paths relative to `root`, sorted as strings.

    Hidden files and other suffixes are passed over; the folder's own folders are not entered.

    Raises:
        OcnfError: the folder is missing or cannot be read (`missing`), or holds no mesh (`empty`).
    """
    base = Path(root)
    place = base / category / folder
    try:
        names = [p.name for p in place.iterdir()
                 if p.suffix.lower() in FORMATS and not p.name.startswith(".")]
    except OSError as error:
        there = sorted(p.name for p in base.iterdir() if p.is_dir()) if base.is_dir() else None
        raise OcnfError(f"cannot be listed ({error.strerror})", code="missing", where=place, field=category,
                        expected="a folder of meshes" if there is None else f"one of {', '.join(there)}",
                        fix="check the meshes' root folder and the category's name") from error
    if not names:
        raise OcnfError("holds no mesh", code="empty", where=place, field=category,
                        expected=", ".join(FORMATS))
    return sorted(f"{category}/{folder}/{name}" for name in names)
