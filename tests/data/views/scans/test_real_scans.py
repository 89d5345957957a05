"""The shared sequences are read as they are; skipped where the data is not there (`OCNF_DATA`)."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ocnf_data.views.scans import read_scan

DATA = Path(os.environ.get("OCNF_DATA", ""))
pytestmark = pytest.mark.skipif(not (DATA / "scans").is_dir(), reason="OCNF_DATA names no folder with scans/")


@pytest.mark.parametrize(("place", "name", "frames"), [
    ("scans/box", "7scenes", "0:12:3"), ("scans/kitchen", "7scenes", "100:120:5"),
    ("voxlets/fold_0/saved_00229", "voxlets", None), ("voxlets/fold_1/saved_00241", "voxlets", None)])
def test_their_frames_agree_as_read_and_do_not_the_other_way_round(place: str, name: str,
                                                                   frames: str | None) -> None:
    scan = read_scan(DATA / place, frames=frames)
    assert scan.format == name and len(scan.views) in (4, 5) and scan.warnings == ()
    assert scan.agreement.share > 0.8 and scan.agreement.share > scan.agreement.inverse + 0.05
