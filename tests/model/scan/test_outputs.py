"""The files that `fuse` writes, and the lines that it says."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from rich.console import Console
from typer.main import get_command
from typer.testing import CliRunner

from ocnf_data import GridOctree, octree_surface
from ocnf_data.errors import OcnfError
from ocnf_data.meshes import read_mesh
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import Colour, read_scan
from ocnf_model.cli import app
from ocnf_model.scan.run import Asked, run_fuse
from ocnf_model.scan.stages import StageLog

ROOT = Path(__file__).parents[3]
BOX = (0.47, -1.43, 2.27, 0.93, -0.97, 2.73)  # around the sphere of conftest.py


def fuse(scan: Path, out: Path | None, **asked: object) -> str:
    """What is printed."""
    console = Console(file=io.StringIO(), width=400)
    run_fuse(str(scan), Asked(out, **{"methods": ["volfus"], "box": BOX, "resolution": 32, **asked}), console)
    return console.file.getvalue()


def test_several_methods_each_have_their_files_and_one_picture(scan: Path, tmp_path: Path) -> None:
    said = fuse(scan, tmp_path / "mesh.ply", methods=["tvl1,volfus", "volfus"], picture=tmp_path / "all.png",
                tsdf=tmp_path / "tsdf.npz", preview=tmp_path / "box.png", reading={"frames": 8})
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["all.png", "box.png", "mesh-tvl1.ply", "mesh-volfus.ply", "tsdf-tvl1.npz",
                     "tsdf-volfus.npz"]
    assert all(len(trimesh.load(tmp_path / f"mesh-{name}.ply").faces) > 1000 for name in ("tvl1", "volfus"))
    picture = cv2.imread(str(tmp_path / "all.png"))
    half = picture.shape[1] // 2
    for part in (picture[:, :half], picture[:, half:]):  # clay in both columns
        assert ((part.max(axis=-1) < 230) & (part.min(axis=-1) > 60)).mean() > 0.05
    for name in ("VolFus", "TV-L1", "marching cubes", "loose part"):
        assert name in said


def test_the_preview_alone_needs_no_mesh_and_fuses_nothing(scan: Path, tmp_path: Path) -> None:
    said = fuse(scan, None, preview=tmp_path / "box.png", resolution=None)
    assert [path.name for path in tmp_path.iterdir()] == ["box.png"] and "marching" not in said
    red = (cv2.imread(str(tmp_path / "box.png")).astype(int) - (0x21, 0x12, 0xC1))  # the box, three times
    assert (np.abs(red).max(axis=-1) < 12).sum() > 500


def test_the_region_is_called_what_it_is_and_only_images_that_are_there_count(
        scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = read_scan(scan, frames=4)
    image = np.full((*read.views.size, 3), 90, np.uint8)
    coloured = replace(read, colour=Colour([image, None, image, None], read.views.K))
    for given, asked, what in ((replace(coloured, cube=((0.7, -1.2, 2.5), 0.46)), {"box": None},
                                "the scan's own cube, box 0.47"),
                               (coloured, {"box": None}, "the largest object, box "),
                               (coloured, {}, "box 0.47"),
                               (coloured, {"box": None, "room": True}, "everything seen, box ")):
        monkeypatch.setattr("ocnf_model.scan.run.read_scan", lambda *_, scan=given, **__: scan)
        said = fuse(scan, tmp_path / "mesh.ply", **asked)
        assert re.search(r"^region .* s  (.*)", said, re.MULTILINE)[1].startswith(what)
        assert "vertices from 2 images" in said


@pytest.mark.parametrize("voxel", [None, 0.02])
def test_a_tsdf_file_says_where_it_lies(scan: Path, tmp_path: Path, voxel: float | None) -> None:
    """Marching cubes of what is in the file, at the places in the file, gives the sphere."""
    for suffix in ("npz", "oc"):
        fuse(scan, tmp_path / "mesh.ply", tsdf=tmp_path / f"tsdf.{suffix}", voxel=voxel)
    with np.load(tmp_path / "tsdf.npz") as file:
        stored = dict(file)
    octree = GridOctree.read_oc(tmp_path / "tsdf.oc")
    placing = json.loads((tmp_path / "tsdf.json").read_text())
    np.testing.assert_array_equal(octree.to_dense()[0], stored["tsdf"])
    assert tuple(placing["shape"]) == stored["tsdf"].shape
    for name in ("first", "voxel", "truncation"):
        np.testing.assert_array_equal(placing[name], stored[name])
    z, y, x = np.indices(octree.shape)
    at = placing["first"] + placing["voxel"] * np.stack([x, y, z], -1)
    distance = np.linalg.norm(at - (0.7, -1.2, 2.5), axis=-1) - 0.2
    near = (np.abs(distance) < placing["truncation"] / 2)
    np.testing.assert_allclose((stored["tsdf"] * placing["truncation"])[near], distance[near],
                               atol=1.2 * placing["voxel"])
    middle = np.add(placing["first"], placing["voxel"] * (np.array(octree.shape[::-1]) - 1) / 2)
    vertices, _ = octree_surface(octree, placing["voxel"] * max(octree.shape), centre=tuple(middle))
    mesh = trimesh.load(tmp_path / "mesh.ply")
    assert {tuple(np.round(v, 9)) for v in mesh.vertices} <= {tuple(np.round(v, 9)) for v in vertices}


@pytest.mark.parametrize("asked", [{"voxel": 0.01}, {"voxel": 5e-324}, {}])
def test_a_dense_tsdf_that_is_too_large_is_refused_before_anything_is_fused(
        scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[str, object]) -> None:
    monkeypatch.setattr("ocnf_model.scan.outputs._MAX_DENSE", 30_000)
    monkeypatch.setattr("ocnf_model.scan.run.reconstruct", lambda *_, **__: pytest.fail("it was fused"))
    with pytest.raises(OcnfError, match=r"tsdf.npz: too large as a dense volume.*ends in .oc") as refused:
        fuse(scan, tmp_path / "mesh.ply", tsdf=tmp_path / "tsdf.npz", preview=tmp_path / "box.png",
             reading={"frames": 2}, **asked)
    assert refused.value.code == "too_large" and not list(tmp_path.iterdir())


def test_a_georeferenced_scan_keeps_its_shape_or_is_refused_before_it_is_fused(
        scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shift = np.array([500_000.0, 4_000_000.0, 100.0])
    read = read_scan(scan, every=2)
    views = Views(read.views.depth, read.views.K, read.views.R, read.views.T - read.views.R @ shift)
    monkeypatch.setattr("ocnf_model.scan.run.read_scan", lambda *_, **__: replace(read, views=views))
    box = (*np.add(BOX[:3], shift), *np.add(BOX[3:], shift))
    fuse(scan, tmp_path / "mesh.glb", box=box)
    vertices = read_mesh(tmp_path / "mesh.glb").vertices
    off = np.abs(np.linalg.norm(vertices - shift - (0.7, -1.2, 2.5), axis=1) - 0.2)
    assert len(vertices) > 1000 and off.max() < 0.48 / 32
    monkeypatch.setattr("ocnf_model.scan.run.reconstruct", lambda *_, **__: pytest.fail("it was fused"))
    with pytest.raises(OcnfError, match=r"^STL: .*steps of 0.25 at 3999999"):
        fuse(scan, tmp_path / "mesh.stl", box=box)
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.glb"]


def test_a_write_that_fails_leaves_nothing_behind(scan: Path, tmp_path: Path,
                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> bytes:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OcnfError, match="the disk is full"):
        fuse(scan, tmp_path / "mesh.ply")
    assert not list(tmp_path.iterdir())


def test_times_of_stages_add_up_to_the_clock() -> None:
    console = Console(file=io.StringIO(), width=100)
    began = time.perf_counter()
    log = StageLog(console, began)
    for name in ("one", "two"):
        time.sleep(0.05)  # between stages: belongs to the next
        with log.stage(name) as line:
            time.sleep(0.05)
            line.say(f"the {name}")
    assert log.total == pytest.approx(time.perf_counter() - began, abs=0.02)
    assert sum(seconds for _, seconds in log.seconds) == pytest.approx(log.total, abs=1e-6)
    assert all(0.09 < seconds < 0.3 for _, seconds in log.seconds)
    lines = console.file.getvalue().splitlines()
    assert [line.split()[-1] for line in lines] == ["one", "two"] and lines[0].startswith("one")


def test_the_first_line_comes_before_anything_heavy_is_loaded_and_the_times_are_the_clocks(
        scan: Path, tmp_path: Path) -> None:
    began = time.perf_counter()
    command = [sys.executable, "-m", "ocnf_model.cli", "fuse", "pretrained", str(scan), "--method", "volfus",
               "--out", str(tmp_path / "mesh.glb"), "--resolution", "32"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    blocked = "import sys; sys.modules['torch'] = None; from ocnf_model.cli import main; main()"
    early = subprocess.run([sys.executable, "-c", blocked, *command[3:]], capture_output=True, text=True,
                           env=environment, check=False)
    assert early.stdout.startswith(f"fusing {scan}")
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    wall = time.perf_counter() - began
    lines = [line.split() for line in done.stdout.splitlines()]
    times = [float(words[1]) for words in lines if len(words) > 2 and words[2] == "s"]
    assert [words[0] for words in lines[1:-1]] == ["start", "read", "region", "fuse", "surface", "clean",
                                                   "write"]
    total = float(done.stdout.split(" s in all")[0].split()[-1])
    assert sum(times) == pytest.approx(total, abs=0.06 * len(times))
    assert 0.4 * wall < total < wall  # Python's own start and end are not in it


@pytest.mark.parametrize(("method", "asked", "message"), [
    ("tvl1", {"weight": 0.0}, "not a weight"),
    ("tvl1", {"weight": -1.0}, "not a weight"),
    ("tvl1", {"resolution": 0}, "not a multiple of 8"),
    ("volfus", {"resolution": 0}, "not a multiple of 8"),
    ("volfus", {"resolution": 100}, "not a multiple of 8"),
    ("ours", {"resolution": 0}, "no level of this resolution"),
])
def test_what_a_method_cannot_be_asked_for_is_refused_before_the_scan_is_read(
        method: str, asked: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match=message):
        run_fuse(str(tmp_path / "no scan"), Asked(tmp_path / "mesh.ply", methods=[method], **asked))


@pytest.mark.parametrize("methods", [["volfus"], ["network", "volfus"]])
def test_a_weight_without_tvl1_is_refused(methods: list[str], tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match=r"^--weight: it would have no effect: .*; found 1.0, expected no"):
        run_fuse("no scan", Asked(tmp_path / "mesh.ply", weight=1.0, methods=methods))


@pytest.mark.parametrize("asked", [
    {"weight": 1.0, "methods": ["tvl1"]}, {"weight": 1.0, "methods": ["network,tvl1"]},
    {"device": "cpu", "methods": ["volfus"]}, {"methods": ["tvl1"]}, {},
    {"out": None, "preview": Path("box.png"), "methods": ["volfus"], "resolution": 64},
    {"methods": ["volfus"], "voxel": 0.01, "resolution": 64, "faces": 100, "keep_all": True,
     "keep_unseen": True, "room": True, "tsdf": Path("a.oc"), "preview": Path("box.png")},
])
def test_a_command_may_lose_its_output_or_change_its_methods(asked: dict, tmp_path: Path,
                                                       monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Asked(**{"out": Path("mesh.ply"), **asked}).check()


def test_a_second_box_is_refused(scan: Path, tmp_path: Path) -> None:
    boxes = ["--box", *map(str, BOX)] * 2
    done = subprocess.run([sys.executable, "-m", "ocnf_model.cli", "fuse", "pretrained", str(scan), *boxes,
                           "--out", str(tmp_path / "mesh.ply")], capture_output=True, text=True,
                          env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: --box: given more than once; found 2 times")
    assert not list(tmp_path.iterdir())


def test_every_option_of_one_value_is_refused_the_second_time_however_it_is_spelt(
        monkeypatch: pytest.MonkeyPatch) -> None:
    """And what takes several, or none, is not."""
    monkeypatch.setattr("ocnf_model.scan.run.run_fuse", lambda *_: None)
    command = get_command(app).commands["fuse"]
    values = {"every": "1", "faces": "9", "resolution": "64", "box": "1", "crop": "1,1,1,1",
              "intrinsics": "1,1,1,1"}
    checked = set()
    for option in command.params:
        if option.param_type_name != "option" or option.is_flag or option.name == "help":
            continue
        name, value = option.opts[0], [values.get(option.name, "1")] * option.nargs
        apart, joined = [name, *value], [f"{name}={value[0]}", *value[1:]]
        for first, second in ((apart, apart), (apart, joined), (joined, apart), (joined, joined)):
            done = CliRunner().invoke(app, ["fuse", "RUN", *first, "SCAN", *second, "--room", "--room"])
            if option.multiple:
                assert done.exit_code == 0, done.output
            else:
                assert str(done.exception).startswith(f"{name}: given more than once; found 2 times")
        assert CliRunner().invoke(app, ["fuse", "RUN", "SCAN", *joined, "--room", "--room"]).exit_code == 0
        checked.add(name)
    assert {"--box", "--frames", "--voxel", "--out", "--method", "--axes"} <= checked


def test_axes_and_colour_of_the_command_line_reach_the_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    monkeypatch.setattr("ocnf_model.scan.run.run_fuse", lambda scan, asked, *_: found.append(asked.reading))
    for more in ([], ["--axes", "opengl", "--no-colour"]):
        assert CliRunner().invoke(app, ["fuse", "RUN", "SCAN", *more]).exit_code == 0
    assert [(reading["axes"], reading["colour"]) for reading in found] == [(None, True), ("opengl", False)]


def test_what_lies_far_is_not_used_where_that_is_asked(scan: Path) -> None:
    from ocnf_model.scan.frames import limit_depth

    read = read_scan(scan, every=6)
    depth = read.views.depth
    near = limit_depth(read, 1.5).views.depth
    assert near.max() <= 1.5 < depth.max()
    np.testing.assert_array_equal(near, np.where(depth > 1.5, 0, depth))
    assert limit_depth(read, None) is read
    with pytest.raises(OcnfError, match=r"max_depth: not a depth; found 1.5, expected metres, above 0"):
        limit_depth(read, "1.5")


def test_every_file_of_several_methods_is_checked_first(scan: Path, tmp_path: Path) -> None:
    for name in ("mesh-tvl1.ply", "tsdf-volfus.npz"):
        (tmp_path / name).mkdir()
        with pytest.raises(OcnfError, match=f"{name}: is a folder"):
            fuse(scan, tmp_path / "mesh.ply", methods=["volfus,tvl1"], tsdf=tmp_path / "tsdf.npz")
        assert [path.name for path in tmp_path.iterdir()] == [name]
        (tmp_path / name).rmdir()


@pytest.mark.parametrize("asked", [{"picture": "a.png", "preview": "a.png"},
                                   {"picture": "sub/../a.png", "preview": "a.png"}], ids=str)
def test_two_files_of_one_name_are_refused(asked, scan: Path, tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match="two files would have the same name"):
        fuse(scan, tmp_path / "mesh.ply", **{what: tmp_path / name for what, name in asked.items()})
    assert not list(tmp_path.iterdir())


def test_another_json_file_is_not_replaced_by_where_an_octree_lies(scan: Path, tmp_path: Path) -> None:
    for text in ("{}", "[1]", "no JSON"):
        (tmp_path / "keep.json").write_text(text)
        with pytest.raises(OcnfError, match=r"keep.json: another file lies where"):
            fuse(scan, tmp_path / "mesh.ply", tsdf=tmp_path / "keep.oc")
        assert (tmp_path / "keep.json").read_text() == text
    (tmp_path / "keep.json").unlink()
    for _ in range(2):  # its own is
        fuse(scan, tmp_path / "mesh.ply", tsdf=tmp_path / "keep.oc")
    assert json.loads((tmp_path / "keep.json").read_text())["shape"] == [32, 32, 32]
