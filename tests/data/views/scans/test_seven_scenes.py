"""Scans: what is read is what was measured, and what is wrong is said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.meshes import Normalisation
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import read_scan
from ocnf_data.views.store import KeptViews, ViewStore

K = np.array([[300.0, 0, 15.5], [0, 310.0, 11], [0, 0, 1]])


def pose(angle: float, position: tuple[float, float, float]) -> np.ndarray:
    """Camera to world: turned about y, standing at `position`."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, position[0]], [0, 1, 0, position[1]], [-s, 0, c, position[2]], [0, 0, 0, 1]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three frames of 24 x 32, with missing pixels of both kinds."""
    rng = np.random.default_rng(0)
    np.savetxt(tmp_path / "camera-intrinsics.txt", K)
    for i in range(3):
        depth = rng.integers(200, 5000, (24, 32)).astype(np.uint16)
        depth[0, 0], depth[0, 1] = 0, 65535
        cv2.imwrite(str(tmp_path / f"frame-{i:06d}.depth.png"), depth)
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", pose(0.3 * i, (i, 2.0, -1)))
    return tmp_path


def test_depth_is_metres_and_missing_is_no_measurement(folder: Path) -> None:
    scan = read_scan(folder)
    stored = cv2.imread(str(folder / "frame-000001.depth.png"), cv2.IMREAD_UNCHANGED)
    depth = scan.views.depth[1]
    assert depth[0, 0] == 0 and depth[0, 1] == 0
    np.testing.assert_allclose(depth[1:], stored[1:] / 1000, rtol=1e-6)
    assert scan.notes == () and scan.names[1] == "frame-000001"


def test_poses_lead_from_world_to_camera(folder: Path) -> None:
    views = read_scan(folder).views
    for i in range(3):
        to_world = pose(0.3 * i, (i, 2.0, -1))
        point = to_world @ [0.1, -0.2, 3.0, 1.0]  # in front of the camera
        np.testing.assert_allclose(views.R[i] @ point[:3] + views.T[i], [0.1, -0.2, 3.0], atol=1e-9)


def test_frames_that_are_not_posed_are_left_out_with_a_note(folder: Path) -> None:
    (folder / "frame-000000.pose.txt").unlink()
    np.savetxt(folder / "frame-000001.pose.txt", np.full((4, 4), np.nan))
    np.savetxt(folder / "frame-000007.pose.txt", np.eye(4))
    scan = read_scan(folder)
    assert scan.names == ("frame-000002",)
    assert len(scan.notes) == 3 and "000000" in scan.notes[0]
    (folder / "frame-000002.depth.png").unlink()
    with pytest.raises(OcnfError, match="no frame can be used"):
        read_scan(folder)


def test_every_nth_frame(folder: Path) -> None:
    assert read_scan(folder, every=2).names == ("frame-000000", "frame-000002")


def _write(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


def _image(array: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: cv2.imwrite(str(folder / "frame-000001.depth.png"), array) and None


def _cut(folder: Path) -> None:
    file = folder / "frame-000001.depth.png"
    file.write_bytes(file.read_bytes()[:-40])


def _flip(folder: Path) -> None:
    file = folder / "frame-000001.depth.png"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)


SHEARED = "1 0.2 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1"
MIRRORED = "-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1"


@pytest.mark.parametrize(("spoil", "message"), [
    (_write("frame-000001.pose.txt", SHEARED), "pose.txt: R.0.: not a rotation"),
    (_write("frame-000001.pose.txt", MIRRORED), "not a rotation"),
    (_write("frame-000001.pose.txt", "1 0 0\n0 1 0\n0 0 1"), "pose.txt: wrong size of matrix; found 9"),
    (_write("frame-000001.pose.txt", "one two"), "not a file of numbers"),
    (_write("frame-000001.pose.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2"), "last row"),
    (_write("other-intrinsics.txt", "1 0 0 0 1 0 0 0 1"), "one file of intrinsics"),
    (_write("camera-intrinsics.txt", "300 5 16 0 300 12 0 0 1"), "not a pinhole"),
    (_write("camera-intrinsics.txt", "nan 0 16 0 300 12 0 0 1"), "not a pinhole"),
    (_image(np.zeros((24, 32), np.uint8)), "not a depth map"),
    (_image(np.zeros((24, 32, 3), np.uint16)), "not a depth map"),
    (_image(np.zeros((12, 32), np.uint16)), "frames differ in size"),
    (_write("frame-000001.depth.png", "no picture"), "not a PNG"),
    (_cut, "cut off or damaged"),
    (_flip, "cut off or damaged"),
])
def test_a_bad_scan_is_refused_with_its_file(folder: Path, spoil: Callable[[Path], None],
                                             message: str) -> None:
    spoil(folder)
    with pytest.raises(OcnfError, match=message) as caught:
        read_scan(folder)
    assert str(folder) in str(caught.value)


def test_places_that_are_no_scans(folder: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    for place, message in ((tmp_path / "nowhere", "no such scan"), (empty, "not a scan of a known format"),
                           (folder / "camera-intrinsics.txt", "not a scan")):
        with pytest.raises(OcnfError, match=message):
            read_scan(place)
    np.savetxt(empty / "intrinsics.txt", K)
    with pytest.raises(OcnfError, match="holds no frames"):
        read_scan(empty)


def test_kept_views(tmp_path: Path) -> None:
    depth = np.full((3, 4, 5), np.inf, np.float32)
    depth[1, 2, 2] = 1.5
    views = Views(depth, K, np.stack([np.eye(3)] * 3), np.zeros((3, 3)))
    ViewStore(tmp_path).keep("chair", KeptViews(views, "0" * 64, "0" * 64, Normalisation(np.zeros(3), 1.0),
                                                3.0))
    scan = read_scan(f"{tmp_path}/chair.h5::chair")
    np.testing.assert_array_equal(scan.views.depth, depth)
    assert scan.cube == ((0.0, 0.0, 0.0), 3.0)
    with pytest.raises(OcnfError, match="no views of that item"):
        read_scan(f"{tmp_path}/chair.h5::table")


@pytest.mark.parametrize(("field", "value"), [
    ("depth_scale", 5000), ("intrinsics", (9, 9, 9, 9)), ("poses", "world-to-camera"), ("pose_scale", 1e-3),
    ("crop", (0, 0, 1, 0))])
def test_kept_views_are_read_in_one_way_only(tmp_path: Path, field: str, value: object) -> None:
    """What would change nothing is refused, and by name: whoever says it expects other views."""
    views = Views(np.ones((1, 4, 5), np.float32), K, np.eye(3)[None], np.zeros((1, 3)))
    ViewStore(tmp_path).keep("chair", KeptViews(views, "0" * 64, "0" * 64, Normalisation(np.zeros(3), 1.0),
                                                3.0))
    with pytest.raises(OcnfError, match="kept views say themselves") as caught:
        read_scan(f"{tmp_path}/chair.h5", **{field: value})
    assert caught.value.field == field
    plain = {"depth_scale": None, "intrinsics": None, "poses": None, "pose_scale": 1, "crop": [0, 0, 0, 0]}
    assert len(read_scan(f"{tmp_path}/chair.h5", **plain).views) == 1
