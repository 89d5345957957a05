"""Where a file can be written, and where not."""

from __future__ import annotations

from pathlib import Path

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.files.targets import check_file


@pytest.mark.parametrize(("name", "message"), [
    ("folder", "folder: is a folder, not a file"), ("file/new", "a part of the path is a file, not a folder"),
    ("file/some/new", "a part of the path is a file"), ("/proc/new", "/proc/new: "),
])
def test_what_cannot_be_written_is_said_and_nothing_made(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("kept")
    with pytest.raises(OcnfError, match=message):
        check_file(tmp_path / name)
    check_file(tmp_path / "file")
    check_file(tmp_path / "new" / "folders" / "file")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]
    assert (tmp_path / "file").read_text() == "kept"
