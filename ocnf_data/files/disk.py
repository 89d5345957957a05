"""Reading and writing on the local disk so that neither a short read nor a power cut goes unnoticed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO


def read_exactly(file: IO[bytes], size: int) -> bytes:
    """Up to `size` bytes; the kernel may give fewer at a time."""
    data = file.read(size) or b""
    while len(data) < size and (more := file.read(size - len(data))):
        data += more
    return data


def flush(path: Path) -> None:
    """Flush a file or folder to the disk: after a power cut, what was renamed is there, contents and all."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Make a folder and its parents, and flush every new entry."""
    if folder.is_dir():
        return
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    flush(folder.parent)
