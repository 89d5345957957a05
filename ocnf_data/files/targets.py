"""Whether a file can be written, found out before the hours of work whose result it is to hold."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import TEMPORARY_PREFIX, storage_errors


def check_target(path: Path, suffixes: Sequence[str]) -> None:
    """Raise OcnfError unless a file of this name can be written: its suffix, and its folder."""
    if path.suffix.lower() not in suffixes:
        raise OcnfError("cannot be written in this format", where=path, found=path.suffix or "no suffix",
                        expected=", ".join(suffixes))
    check_file(path)


def check_file(path: Path) -> None:
    """Raise OcnfError unless a file of this name can be written; folders that it needs may be missing."""
    if path.is_dir():
        raise OcnfError("is a folder, not a file", code="io", where=path)
    if path.exists() and not os.access(path, os.W_OK):  # it would be replaced, whatever its own permissions
        raise OcnfError("the file is read-only", code="permission", where=path, fix="name another file")
    folder = path.absolute().parent
    while not folder.exists():
        folder = folder.parent
    with storage_errors(path), tempfile.TemporaryFile(dir=folder, prefix=TEMPORARY_PREFIX):
        pass
