"""Figures as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.files.targets import check_target

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURE_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".pdf", ".svg")


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure; folders that are missing are made.

    Raises:
        OcnfError: another format, or the file cannot be written.
    """
    check_target(path, PICTURE_SUFFIXES)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=90)
