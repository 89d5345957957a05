"""The shared sequences are read as they are; skipped where the data is not there (`OCNF_DATA`)."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ocnf_data.views.scans import read_scan

DATA = Path(os.environ.get("OCNF_DATA", ""))
pytestmark = pytest.mark.skipif(not (DATA / "scans").is_dir(), reason="OCNF_DATA names no folder with scans/")


@pytest.mark.parametrize(("place", "frames", "said"), [
    ("scans/box", None, {"depth_scale": 2000}), ("scans/box", None, {"pose_scale": 0.5}),
    ("scans/kitchen", 20, {"depth_scale": 500}), ("scans/kitchen", "50:101", {"depth_scale": 5000})])
def test_another_scale_is_noticed_in_real_scans(place: str, frames: str | int | None, said: dict) -> None:
    """Frames of a film agree to 78 to 93 % under them, but more under the right one."""
    assert read_scan(DATA / place, frames=frames).warnings == ()
    (warning,) = read_scan(DATA / place, frames=frames, **said).warnings
    assert "the scale of the depth or of the poses may be wrong" in warning


@pytest.mark.parametrize(("place", "name", "frames"), [
    ("scans/box", "7scenes", "0:12:3"), ("scans/kitchen", "7scenes", "100:120:5"),
    ("voxlets/fold_0/saved_00229", "voxlets", None), ("voxlets/fold_1/saved_00241", "voxlets", None)])
def test_their_frames_agree_as_read_and_do_not_the_other_way_round(place: str, name: str,
                                                                   frames: str | None) -> None:
    scan = read_scan(DATA / place, frames=frames)
    assert scan.format == name and len(scan.views) in (4, 5) and scan.warnings == ()
    assert scan.agreement.share > 0.8 and scan.agreement.share > scan.agreement.inverse + 0.05
