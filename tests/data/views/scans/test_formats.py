"""The same scene comes back from every format, and what is wrong with one is said in a sentence."""

from __future__ import annotations

import importlib
import json
import re
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.views.scans import SCAN_FORMATS, Scan, list_scan, read_scan

ALL = ["7scenes", "tum", "open3d", "open3d-json", "transforms", "scannet", "voxlets"]
Write = Callable[[str], Path]


def to_world(scan: Scan) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(scan.views), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = scan.views.R, scan.views.T
    return np.linalg.inv(poses)


@pytest.mark.parametrize("name", ALL)
def test_the_same_views_from_every_format(scene, write: Write, name: str) -> None:
    scan = read_scan(write(name))
    assert scan.format == name.partition("-")[0]
    unit = 1 / 5000 if name == "tum" else 1 / 1000
    np.testing.assert_allclose(scan.views.depth, scene.depth, atol=0.5 * unit + 1e-6)
    np.testing.assert_array_equal(scan.views.depth == 0, scene.depth == 0)
    np.testing.assert_allclose(to_world(scan), scene.poses, atol=1e-8)
    np.testing.assert_allclose(scan.views.K, np.broadcast_to(
        [[55.0, 0, 31.2], [0, 56.0, 23.4], [0, 0, 1]], (5, 3, 3)), atol=1e-9)
    assert scan.warnings == () and scan.agreement.share > 0.8 > scan.agreement.inverse + 0.1


@pytest.mark.parametrize("name", ALL)
def test_colour_lies_on_the_depth(scene, write: Write, name: str) -> None:
    colour = read_scan(write(name), frames="1:3").colour
    image, (u, v) = colour.image(1), (40, 20)  # frame 2
    x, y = (u - 31.2) / 55.0, (v - 23.4) / 56.0
    cu, cv = (colour.K[1] @ [x, y, 1])[:2]
    at = image[int(np.floor(cv + 0.5)), int(np.floor(cu + 0.5))]
    np.testing.assert_array_equal(at, scene.colour[2, v, u])


@pytest.mark.parametrize("name", ALL)
def test_poses_the_wrong_way_round_are_noticed_with_both_figures(write: Write, name: str) -> None:
    folder = write(name)
    right = read_scan(folder).agreement
    scan = read_scan(folder, poses="camera-to-world" if name == "open3d-json" else "world-to-camera")
    (warning,) = scan.warnings
    assert "other way round" in warning and f"{100 * right.share:.0f} %" in warning
    assert f"{100 * scan.agreement.share:.0f} %" in warning


@pytest.mark.parametrize("name", sorted(SCAN_FORMATS))
def test_a_format_can_be_named_and_a_wrong_one_is_refused(write: Write, name: str) -> None:
    folder = write(name)
    assert read_scan(folder, format=name).format == name
    for other in SCAN_FORMATS:
        if other != name:
            with pytest.raises(OcnfError):
                read_scan(folder, format=other)
    with pytest.raises(OcnfError, match="no such format"):
        read_scan(folder, format="kitti")


def test_two_formats_in_one_folder_have_to_be_told_apart(write: Write) -> None:
    folder = write("tum")
    shutil.copytree(write("7scenes"), folder, dirs_exist_ok=True)
    with pytest.raises(OcnfError, match="fits several formats; found 7scenes, tum"):
        read_scan(folder)
    assert read_scan(folder, format="tum").names[0].startswith("1305")


def test_numbers_in_names_count_as_numbers(write: Write) -> None:
    assert read_scan(write("scannet")).names == ("0", "5", "10", "15", "20")


def test_lost_tracking_is_left_out_by_name(write: Write) -> None:
    assert read_scan(write("scannet")).notes == (
        "1 frame whose pose is not known (NaN or infinite), left out: 100",)


def test_many_frames_that_are_left_out_are_one_line(write: Write) -> None:
    folder = write("scannet")
    for i in [*range(105, 400, 5), 500]:
        np.savetxt(folder / f"pose/{i}.txt", np.full((4, 4), np.nan))
        shutil.copy(folder / "depth/0.png", folder / f"depth/{i}.png")
    for i in (600, 607, 608):
        shutil.copy(folder / "depth/0.png", folder / f"depth/{i}.png")
        np.savetxt(folder / f"pose/{1000 - i}.txt", np.eye(4))
    assert read_scan(folder).notes == (
        "3 depth maps without a pose, left out: 600 to 608",
        "3 poses without a depth map, left out: 392, 393, 400",
        "61 frames whose pose is not known (NaN or infinite), left out: 100 to 500")
    np.savetxt(folder / "pose/200.txt", np.eye(4))
    assert read_scan(folder).notes[-1] == (
        "60 frames whose pose is not known (NaN or infinite), left out: 100 to 195, 205 to 500")
    for i in range(110, 400, 20):
        np.savetxt(folder / f"pose/{i}.txt", np.eye(4))
    note = read_scan(folder).notes[-1]
    assert note.startswith("45 frames") and "left out: 100, 105, 115 to 125, 135 to" in note
    assert note.endswith(" 275 to 285, and 7 more such")
    folder = write("transforms")
    _json("transforms.json", lambda d: [d["frames"][i].pop("depth_file_path") for i in (0, 2, 3, 4)])(folder)
    assert read_scan(folder).notes == (
        "4 frames without depth_file_path, left out: frames[0], frames[2] to frames[4]",)


def test_what_the_user_says_wins(scene, write: Write) -> None:
    folder = write("7scenes")
    scan = read_scan(folder, depth_scale=500, intrinsics=(50, 51, 30, 20), pose_scale=2.0, crop=(3, 2, 1, 4))
    np.testing.assert_allclose(scan.views.depth[2, 2:44, 3:63], 2 * scene.depth[2, 2:44, 3:63], atol=2e-3)
    outside = np.ones((48, 64), bool)
    outside[2:44, 3:63] = False
    assert (scan.views.depth[:, outside] == 0).all()
    np.testing.assert_array_equal(scan.views.K[0], [[50, 0, 30], [0, 51, 20], [0, 0, 1]])
    np.testing.assert_allclose(to_world(scan)[:, :3, 3], 2 * scene.poses[:, :3, 3], atol=1e-8)
    (folder / "camera-intrinsics.txt").unlink()
    with pytest.raises(OcnfError, match=r"does not say its intrinsics.*FX,FY,CX,CY"):
        read_scan(folder)
    assert read_scan(folder, intrinsics=(55, 56, 31.2, 23.4)).warnings == ()


@pytest.mark.parametrize("name", ["open3d", "open3d-json"])
def test_the_depth_scale_that_open3d_writes_holds_unless_the_user_says_another(scene, write: Write,
                                                                               name: str) -> None:
    folder = write(name)
    for i in range(5):
        cv2.imwrite(str(folder / f"depth/{i + 1}.png"), scene.stored(i, 4000))
    if not (folder / "intrinsic.json").exists():
        (folder / "intrinsic.json").write_text("{}")
    _json("intrinsic.json", lambda d: d.update(depth_scale=4000, device_name="Intel RealSense L515"))(folder)
    scan = read_scan(folder)
    np.testing.assert_allclose(scan.views.depth, scene.depth, atol=0.5 / 4000 + 1e-6)
    assert scan.warnings == ()
    np.testing.assert_array_equal(read_scan(folder, intrinsics=(55, 56, 31.2, 23.4)).views.depth,
                                  scan.views.depth)
    np.testing.assert_allclose(read_scan(folder, depth_scale=8000).views.depth, scan.views.depth / 2)
    (folder / "color_intrinsic.json").write_text('{"depth_scale": 1000}')
    with pytest.raises(OcnfError, match=r"differ in their depth scale; found 1000 \(color_.*, 4000 \(intr"):
        read_scan(folder)
    for value in (0, -1, None, "4000", True, [4000], float("nan"), float("inf"), 10**400, 1e-320):
        (folder / "color_intrinsic.json").write_text(json.dumps({"depth_scale": value}))
        with pytest.raises(OcnfError, match=r"color_intrinsic.json: depth_scale: not a scale"):
            read_scan(folder)


def test_a_capture_that_was_scaled_says_what_undoes_it(scene, write: Write) -> None:
    folder = write("transforms")
    scaled = scene.poses.copy()
    scaled[:, :3, 3] *= 0.3
    _json("transforms.json", lambda d: d.update(applied_scale=0.3, frames=[
        {**frame, "transform_matrix": (pose @ np.diag([1, -1, -1, 1])).tolist()}
        for frame, pose in zip(d["frames"], scaled, strict=True)]))(folder)
    note = next(note for note in read_scan(folder).notes if "applied_scale" in note)
    scale = float(note.split("--pose-scale ")[1].rstrip(")"))
    np.testing.assert_allclose(to_world(read_scan(folder, pose_scale=scale)), scene.poses, atol=1e-8)
    for value in (None, "x", 0, -2, False, float("nan"), 10**400):
        _json("transforms.json", lambda d, value=value: d.update(applied_scale=value))(folder)
        with pytest.raises(OcnfError, match=r"transforms.json: applied_scale: not a scale"):
            read_scan(folder)


@pytest.mark.parametrize(("name", "axes"), [("7scenes", "opengl"), ("transforms", "opencv")])
def test_axes_of_the_users_win(scene, write: Write, name: str, axes: str) -> None:
    """The poses are written with the axes that the format does not have."""
    folder, flip = write(name), np.diag([1.0, -1, -1, 1])
    for i, pose in enumerate(scene.poses):
        if name == "7scenes":
            np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose @ flip)
    _json("transforms.json", lambda d: [frame.update(transform_matrix=pose.tolist()) for frame, pose in zip(
        d["frames"], scene.poses, strict=True)])(folder) if name == "transforms" else None
    scan = read_scan(folder, axes=axes)
    np.testing.assert_allclose(to_world(scan), scene.poses, atol=1e-8)
    assert scan.warnings == () and scan.agreement.share > 0.8
    assert read_scan(folder).agreement.share < 0.6


def test_tums_own_intrinsics_are_taken_for_its_own_size_only_and_said(write: Write) -> None:
    folder = write("tum")
    (folder / "calibration.txt").unlink()
    with pytest.raises(OcnfError, match="does not say its intrinsics"):
        read_scan(folder)
    for file in (folder / "depth").iterdir():
        small = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), small.repeat(10, axis=0).repeat(10, axis=1))
    scan = read_scan(folder)
    np.testing.assert_array_equal(scan.views.K[3], [[525, 0, 319.5], [0, 525, 239.5], [0, 0, 1]])
    assert "525,525,319.5,239.5" in scan.notes[0]


def _edit(file: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_text(change((folder / file).read_text())) and None


def _json(file: str, change: Callable[[dict], object]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        data = json.loads((folder / file).read_text())
        change(data)
        (folder / file).write_text(json.dumps(data))

    return edit


def _remove(pattern: str) -> Callable[[Path], None]:
    return lambda folder: [file.unlink() for file in folder.glob(pattern)] and None


def _image(file: str, height: int = 10, width: int = 12) -> Callable[[Path], None]:
    return lambda folder: cv2.imwrite(str(folder / file), np.ones((height, width), np.uint16)) and None


def _huge(file: str) -> Callable[[Path], None]:
    """A PNG of 60 bytes that says it is 100,000 pixels on either side."""
    def write(folder: Path) -> None:
        chunks = [(b"IHDR", struct.pack(">IIBBBBB", 100_000, 100_000, 16, 0, 0, 0, 0)), (b"IEND", b"")]
        (folder / file).write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
            for name, data in chunks))

    return write


def _cut(file: str, left: int = 200) -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_bytes((folder / file).read_bytes()[:left]) and None


def _header(file: str, header: bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / file).write_bytes(header + bytes(100)) and None


def _scale_log(text: str) -> str:
    lines = text.splitlines()
    return "\n".join(" ".join([*line.split()[:3], str(1000 * float(line.split()[3]))])
                     if i % 5 in (1, 2, 3) else line for i, line in enumerate(lines))


SPOILT = [
    # missing poses
    ("7scenes", _remove("*.pose.txt"), "no frame can be used"),
    ("tum", _remove("groundtruth.txt"), "has no poses"),
    ("open3d", _remove("scene/*"), "one trajectory; found none"),
    ("transforms", _json("transforms.json", lambda d: d["frames"][1].pop("transform_matrix")),
     r"frames\[1\].transform_matrix: not a matrix"),
    ("scannet", _remove("pose/*"), "has no poses"),
    ("voxlets", _remove("poses/*"), "has no poses"),
    # a depth file of another size, or of the wrong kind
    ("7scenes", _image("frame-000002.depth.png"), "000002.depth.png: frames differ in size"),
    ("open3d", _image("depth/3.png"), "3.png: the intrinsics are for images of another size"),
    ("scannet", _image("depth/10.png"), "10.png: frames differ in size"),
    ("tum", _image("depth/1305031102.260000.png"), "frames differ in size"),
    # a pose file with a comment or a comma
    ("7scenes", _edit("frame-000001.pose.txt", lambda t: "# camera\n" + t), "line 1: not a file of numbers"),
    ("7scenes", _edit("frame-000001.pose.txt", lambda t: t.replace(" ", ", ")),
     "found '.*,', expected.*comma"),
    ("scannet", _edit("pose/5.txt", lambda t: t.replace(" ", ",")), "not a file of numbers"),
    ("tum", _edit("groundtruth.txt", lambda t: t.replace(" ", ",")), "groundtruth.txt: line 2: not a file"),
    ("tum", _edit("depth.txt", lambda t: t.replace(" ", ",")), "depth.txt: line 3: not a timestamp"),
    ("open3d", _edit("scene/trajectory.log", lambda t: t.replace("0 0 1", "0, 0, 1")), "line 1: not a file"),
    ("open3d", _edit("scene/trajectory.log", lambda t: t[:-60]), "not a trajectory log"),
    # a trajectory in millimetres
    ("open3d", _edit("scene/trajectory.log", _scale_log),
     "look like millimetres.*pose scale 0.001.*--pose-scale 0.001"),
    # not finite, not rigid
    ("scannet", _edit("pose/5.txt", lambda t: "2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1"),
     "5.txt: R.*not a rotation"),
    ("transforms", _json("transforms.json", lambda d: d["frames"][2].update(
        transform_matrix=np.diag([1, 1, -1, 1]).tolist())), "00002.png: R.*not a rotation"),
    ("tum", _edit("groundtruth.txt", lambda t: "\n".join(
        " ".join([*line.split()[:4], "0 0 0 0"]) for line in t.splitlines())), "no frame can be used"),
    # intrinsics
    ("scannet", _edit("intrinsic/intrinsic_depth.txt", lambda t: "nan " + t.partition(" ")[2]),
     "not a pinhole"),
    ("tum", _edit("calibration.txt", lambda t: "nan 5 5 5"), "not a pinhole"),
    ("open3d", _json("intrinsic.json", lambda d: d["intrinsic_matrix"].__setitem__(0, float("nan"))),
     "not a pinhole"),
    ("transforms", _json("transforms.json", lambda d: d.update(fl_x=float("nan"))), "not a pinhole"),
    ("transforms", _json("transforms.json", lambda d: d.update(camera_model="OPENCV_FISHEYE")),
     "not a pinhole"),
    ("voxlets", _edit("poses/000001.yaml", lambda t: t.replace("[55.0", "[.nan")), "not a pinhole"),
    # images
    ("7scenes", _huge("frame-000000.depth.png"), "impossible size of image; found 100000x100000"),
    ("scannet", _huge("depth/0.png"), "impossible size of image"),
    ("voxlets", _header("frames/00002.pgm", b"P5 99999 99999 65535\n"), "impossible size of image"),
    ("voxlets", _cut("frames/00002.pgm"), "cut off"),
    ("voxlets", _header("frames/00002.pgm", b"no picture"), "not a known image"),
    ("tum", _cut("depth/1305031102.160000.png"), "cut off or damaged"),
    # files elsewhere
    ("tum", _edit("depth.txt", lambda t: t.replace(" depth/", " ../tum/depth/")),
     r"depth.txt: line 3: not a path below the scan's folder; found \.\./tum/depth"),
    ("tum", _edit("rgb.txt", lambda t: t.replace(" rgb/", " /rgb/")),
     r"rgb.txt: line 1: not a path below the scan's folder; found /rgb"),
    ("voxlets", _edit("poses/000001.yaml", lambda t: t.replace("image: ", "image: ../voxlets/")),
     "000001.yaml: image: not a path below the scan's folder"),
    ("transforms", _json("transforms.json", lambda d: d["frames"][1].update(file_path="..\\a.png")),
     r"frames\[1\].file_path: not a path below the scan's folder"),
    # YAML with tags that would run code
    ("voxlets", _edit("poses/000001.yaml", lambda t: t + "x: !!python/object/apply:os.system ['false']\n"),
     "000001.yaml.*not valid YAML.*os.system"),
    ("voxlets", _edit("tsdf_meta.yaml", lambda t: "shape: !!python/name:os.system\n"), "not valid YAML"),
    ("voxlets", _edit("poses/000001.yaml", lambda t: t.replace("frames/", "../frames/")), "below the scan's"),
    # JSON
    ("transforms", _edit("transforms.json", lambda t: t[:50]), "not valid JSON.*|line 1, column"),
    ("transforms", _edit("transforms.json", lambda t: "[" * 100_000), "not valid JSON"),
    ("transforms", _json("transforms.json", lambda d: d["frames"][0].update(depth_file_path="/etc/passwd")),
     "not a path below"),
    ("transforms", _json("transforms.json", lambda d: [f.pop("depth_file_path") for f in d["frames"]]),
     "no frame has depth"),
    ("open3d-json", _json("trajectory.json", lambda d: d["parameters"].pop()), "4 poses, 5 depth maps"),
    # nothing measured of what was asked for
    ("tum", _edit("depth.txt", lambda t: t.replace("\n1305", "\n9305")),
     "no depth map has a pose of its time"),
]


@pytest.mark.parametrize(("name", "spoil", "message"), SPOILT)
def test_bad_input_is_a_sentence(write: Write, name: str, spoil: Callable[[Path], None],
                                 message: str) -> None:
    folder = write(name)
    spoil(folder)
    with pytest.raises(OcnfError, match=message) as caught:
        read_scan(folder)
    assert name in str(caught.value)  # the folder's name: what was wrong is said where


def test_the_one_tag_builds_a_tuple_and_nothing_else(write: Write) -> None:
    folder = write("voxlets")
    assert read_scan(folder).cube == (pytest.approx((0.43, 0.32, 0.2)), pytest.approx(0.86))


@pytest.mark.parametrize(("frames", "expected"), [
    (None, [0, 1, 2, 3, 4]), ("2", [0, 4]), (3, [0, 2, 4]), ("5", [0, 1, 2, 3, 4]), ("1:4", [1, 2, 3]),
    ("1:5:2", [1, 3]), (":2", [0, 1]), ("3:", [3, 4]), ("::4", [0, 4])])
def test_frames_are_chosen_by_number_or_range(write: Write, frames: object, expected: list[int]) -> None:
    assert [int(name[-1]) for name in read_scan(write("7scenes"), frames=frames).names] == expected


@pytest.mark.parametrize(("asked", "message"), [
    ({"frames": "some"}, "not a choice of frames"), ({"frames": "0"}, "not a choice"),
    ({"frames": "1:5:0"}, "not a choice"), ({"frames": "9:12"}, "the scan has fewer frames"),
    ({"frames": "6"}, "the scan has fewer frames"), ({"frames": "2:6"}, "the scan has fewer frames"),
    ({"frames": "3:3"}, "no frame is chosen"),
    ({"frames": "-3"}, "not a choice"), ({"every": 0}, "not a step"), ({"depth_scale": 0.0}, "not a scale"),
    ({"pose_scale": float("nan")}, "not a scale"), ({"poses": "inverse"}, "not a direction"),
    ({"intrinsics": (1, 2, 3)}, "not intrinsics"), ({"intrinsics": (float("nan"), 2, 3, 4)}, "not a pinhole"),
    ({"crop": (1, 2, 3)}, "not a crop"), ({"crop": (40, 0, 40, 0)}, "leaves nothing"),
    ({"crop": (-1, 0, 0, 0)}, "not a crop"), ({"crop": (float("nan"), 0, 0, 0)}, "not a crop"),
    ({"crop": (0, 0, float("inf"), 0)}, "not a crop")])
def test_bad_wishes(write: Write, asked: dict[str, object], message: str) -> None:
    with pytest.raises(OcnfError, match=message):
        read_scan(write("7scenes"), **asked)


def test_a_wrong_depth_scale_is_warned_of(write: Write) -> None:
    (warning,) = read_scan(write("7scenes"), depth_scale=3000).warnings
    assert "the scale of the depth or of the poses may be wrong" in warning and "4 times as large" in warning


def _as_npy(folder: Path, change: Callable[[np.ndarray], np.ndarray] = lambda depth: depth) -> None:
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"]:
        stored = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        frame["depth_file_path"] = frame["depth_file_path"].replace(".png", ".npy")
        np.save(folder / frame["depth_file_path"], change(stored.astype(np.float32)), allow_pickle=True)
    (folder / "transforms.json").write_text(json.dumps(data))


@pytest.mark.parametrize("missing", [np.nan, np.inf])
def test_depth_as_npy(missing: float, scene, write: Write) -> None:
    folder = write("transforms")
    _as_npy(folder, lambda depth: np.where(depth == 0, missing, depth))
    np.testing.assert_allclose(read_scan(folder).views.depth, scene.depth, atol=6e-4)
    file = folder / "depth/00002.npy"
    file.write_bytes(file.read_bytes()[:-8])
    with pytest.raises(OcnfError, match=r"00002\.npy: the NPY is cut off"):
        read_scan(folder)
    np.save(file, np.empty((48, 64), object), allow_pickle=True)
    with pytest.raises(OcnfError, match="not a readable NPY of numbers"):
        read_scan(folder)


def test_colour_that_is_not_there_is_not_needed(scene, write: Write) -> None:
    for name in ("transforms", "7scenes", "scannet", "open3d", "voxlets"):
        folder = write(name)
        for pattern in ("images", "*.color.png", "color", "frames/*.ppm"):
            for found in folder.glob(pattern):
                shutil.rmtree(found) if found.is_dir() else found.unlink()
        scan = read_scan(folder)
        assert scan.colour is None
        np.testing.assert_allclose(scan.views.depth, scene.depth, atol=6e-4)


def test_a_damaged_jpeg_is_a_sentence(write: Write) -> None:
    folder = write("scannet")
    for file in (folder / "color").iterdir():
        image = cv2.imread(str(file))
        cv2.imwrite(str(file.with_suffix(".jpg")), image)
        file.unlink()
    scan = read_scan(folder)
    assert scan.colour.image(0).shape == (48, 64, 3)
    broken = folder / "color/0.jpg"
    data = broken.read_bytes()
    at = data.index(b"\xff\xc0")
    broken.write_bytes(data[: at + 5] + b"\xff\xff\xff\xff" + data[at + 9 :])
    with pytest.raises(OcnfError, match="impossible size of image; found 65535x65535"):
        scan.colour.image(0)
    broken.write_bytes(data[:at])
    with pytest.raises(OcnfError, match="cut off or damaged"):
        scan.colour.image(0)


def test_progress_counts_to_the_end(write: Write) -> None:
    told: list[tuple[int, int]] = []
    read_scan(write("tum"), report=lambda done, of: told.append((done, of)))
    assert told == [(i, 5) for i in range(1, 6)]


def test_colour_larger_than_depth_has_the_depths_intrinsics_scaled(scene, write: Write) -> None:
    folder = write("7scenes")
    for i in range(5):
        large = scene.colour[i].repeat(2, axis=0).repeat(2, axis=1)
        cv2.imwrite(str(folder / f"frame-{i:06d}.color.png"), large[:, :, ::-1])
    cv2.imwrite(str(folder / "frame-000004.color.png"), np.zeros((60, 60, 3), np.uint8))
    scan = read_scan(folder)
    np.testing.assert_allclose(scan.colour.K[0], [[110, 0, 62.9], [0, 112, 47.3], [0, 0, 1]])
    assert scan.colour.image(4) is None and "1 of 5 frames are without their colour" in scan.notes[1]


def test_of_several_files_of_intrinsics_the_depths_holds(write: Write) -> None:
    folder = write("open3d")
    text = (folder / "intrinsic.json").read_text()
    (folder / "intrinsic.json").rename(folder / "depth_intrinsic.json")
    (folder / "color_intrinsic.json").write_text(text.replace("55.0", "90.0"))
    assert read_scan(folder).views.K[0, 0, 0] == 55
    (folder / "depth_intrinsic.json").rename(folder / "other_intrinsic.json")
    with pytest.raises(OcnfError, match="several files of intrinsics"):
        read_scan(folder)
    assert read_scan(folder, intrinsics=(55, 56, 31.2, 23.4)).views.K[0, 0, 0] == 55


@pytest.mark.parametrize(("name", "spoil", "fault"), [
    ("open3d-json", _json("trajectory.json", lambda d: d["parameters"][2]["intrinsic"].pop("width")),
     "not an image's size; found nanx48"),
    ("open3d-json", _json("trajectory.json",
                          lambda d: d["parameters"][0]["intrinsic"].update(intrinsic_matrix="none")),
     "intrinsic_matrix: not a matrix of numbers"),
    ("open3d", _edit("intrinsic.json", lambda text: text[:-9]), "not valid JSON"),
])
def test_a_camera_that_is_not_needed_may_be_malformed(write: Write, name: str, fault: str,
                                                      spoil: Callable[[Path], None]) -> None:
    folder = write(name)
    spoil(folder)
    with pytest.raises(OcnfError, match=fault):
        read_scan(folder)
    assert (read_scan(folder, intrinsics=(55, 56, 31.2, 23.4)).views.K[:, 0, 0] == 55).all()


@pytest.mark.parametrize(("change", "fault"), [
    ({"w": None, "h": None}, "unknown size"), ({"w": 96, "h": 128}, "not the image scaled")])
def test_a_capture_whose_intrinsics_cannot_be_scaled(write: Write, change: dict, fault: str) -> None:
    folder = write("transforms")
    shutil.rmtree(folder / "images")
    _json("transforms.json", lambda d: d.update(change))(folder)
    with pytest.raises(OcnfError, match=fault):
        read_scan(folder)
    assert read_scan(folder, intrinsics=(55, 56, 31.2, 23.4)).views.K[0, 0, 0] == 55


def test_a_capture_says_its_distortion_and_keeps_its_centre(write: Write) -> None:
    folder = write("transforms")
    _json("transforms.json", lambda d: d.update(distortion_params=[0.3, 0], fl_x=None, fl_y=None,
                                                camera_angle_x=1.0, camera_angle_y=0.9))(folder)
    (folder / "images/00000.png").write_bytes(b"RIFF1234WEBPxxxx")
    scan = read_scan(folder)
    assert "up to 0.3" in scan.notes[0] and "without their colour" in scan.notes[1]
    np.testing.assert_allclose(scan.views.K[0], [[32 / np.tan(0.5), 0, 31.2],
                                                 [0, 24 / np.tan(0.45), 23.4], [0, 0, 1]])


def test_tum_takes_what_follows_the_intrinsics_and_misses_no_image(write: Write) -> None:
    folder = write("tum")
    (folder / "calibration.txt").write_text("55 56 31.2 23.4 0.1 0 0 0 0")
    next(iter((folder / "rgb").iterdir())).unlink()
    scan = read_scan(folder)
    assert "5 numbers after" in scan.notes[0] and "without their colour" in scan.notes[1]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".jpeg"])
def test_images_of_a_capture_may_be_named_without_their_suffix(write: Write, suffix: str) -> None:
    folder = write("transforms")
    for file in (folder / "images").iterdir():
        file.rename(file.with_suffix(suffix))
    _json("transforms.json", lambda d: [frame.update(file_path=frame["file_path"].removesuffix(".png"))
                                        for frame in d["frames"]])(folder)
    scan = read_scan(folder)
    assert scan.notes == () and [scan.colour.image(i).shape for i in range(5)] == [(96, 128, 3)] * 5


@pytest.mark.parametrize(("name", "images"), [("transforms", "images/*.png"), ("voxlets", "frames/*.ppm"),
                                              ("tum", "rgb/*.png")])
def test_images_that_are_not_there_are_counted(write: Write, name: str, images: str) -> None:
    folder = write(name)
    files = sorted(folder.glob(images))
    files[1].unlink()
    scan = read_scan(folder)
    assert scan.colour.image(1) is None and scan.colour.image(2) is not None
    assert scan.notes == (
        f"1 of 5 frames are without their colour: the images are not there ({files[1]})",)
    for file in files[:1] + files[2:]:
        file.unlink()
    scan = read_scan(folder)
    assert scan.colour is None and scan.notes[0].startswith("5 of 5 frames are without their colour")
    assert read_scan(folder, colour=False).notes == ()


def test_colour_that_is_not_registered_is_said(write: Write) -> None:
    folder = write("7scenes")
    note, = read_scan(folder).notes
    assert "the published 7-Scenes are not" in note
    plain = read_scan(folder, colour=False)
    assert plain.colour is None and plain.notes == ()


def test_frames_are_in_the_order_of_their_numbers(write: Write) -> None:
    folder = write("7scenes")
    for suffix in ("depth.png", "pose.txt"):
        (folder / f"frame-000001.{suffix}").rename(folder / f"frame-10.{suffix}")
        (folder / f"frame-000003.{suffix}").rename(folder / f"frame-9.{suffix}")
    assert read_scan(folder).names[-2:] == ("frame-9", "frame-10")


@pytest.mark.parametrize(("asked", "message"), [
    ({"every": 2.0}, "every: not a step; found 2.0"), ({"every": "2"}, "every: not a step; found 2,"),
    ({"frames": "²"}, "frames: not a choice of frames; found ²"), ({"frames": "٣"}, "not a choice of frames"),
    ({"frames": "9" * 5000}, "frames: not a choice of frames"), ({"frames": "٠:٣"}, "not a choice of frames"),
    ({"frames": f"0:{'9' * 5000}"}, "frames: not a choice of frames"), ({"frames": 2.0}, "not a choice"),
    ({"intrinsics": ("a", "b", "c", "d")}, "intrinsics: not intrinsics.*four numbers"),
    ({"intrinsics": 525.0}, "intrinsics: not intrinsics.*four numbers"),
    ({"intrinsics": (1, 2, 3)}, "intrinsics: not intrinsics.*four numbers"),
    ({"pose_scale": "0.001"}, "pose_scale: not a scale"),
    ({"depth_scale": "1000"}, "depth_scale: not a scale"),
    ({"depth_scale": True}, "depth_scale: not a scale"),
    ({"axes": "blender"}, "axes: not a convention of axes; found blender, expected opencv or opengl"),
    ({"crop": ("1", "2", "3", "4")}, "crop: not a crop"), ({"crop": 3}, "crop: not a crop"),
])
def test_an_argument_of_another_kind_is_refused_by_name(write: Write, asked: dict, message: str) -> None:
    with pytest.raises(OcnfError, match=message) as refused:
        read_scan(write("7scenes"), **asked)
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize("place", ["", 5, None, b"scan", ["scan"]])
def test_what_is_no_path_is_refused(place: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty one would be the working directory."""
    monkeypatch.chdir(tmp_path)
    for read in (read_scan, list_scan):
        with pytest.raises(OcnfError, match=r"place: not a path; found .*, expected a scan's folder"):
            read(place)


@pytest.mark.parametrize("fitting", [1, 3, 4])
def test_as_many_frames_are_named_as_fit_into_memory(write: Write, monkeypatch: pytest.MonkeyPatch,
                                                     fitting: int) -> None:
    folder = write("7scenes")
    load = importlib.import_module("ocnf_data.views.scans.load")  # the package has a function of this name
    monkeypatch.setattr(load, "usable_memory", lambda: 3 * fitting * 48 * 64 * 4 + 100)
    with pytest.raises(OcnfError, match="frames: too many frames to hold in memory; found 5 of 64x48") as no:
        read_scan(folder)
    assert no.value.code == "too_large"
    named = re.search(r"--frames (\d+)\)\.$", str(no.value))[1]
    assert int(named) == fitting and len(read_scan(folder, frames=named).views) == fitting
    monkeypatch.setattr(load, "usable_memory", lambda: 100)
    with pytest.raises(OcnfError, match=r"expected at most 0 with the 0\.0 GB that may be used$"):
        read_scan(folder)
