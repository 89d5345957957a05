"""A scan comes back as a surface where it was, in the scan's coordinates."""

from __future__ import annotations

import io
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid, fuse_histogram
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import read_scan
from ocnf_model import OctNetFusion, OctreeBatch
from ocnf_model.scan.fuse import Baseline, Learned, fuse_scan, run_fuse
from ocnf_model.scan.region import Region, largest_object, looked_at, observed

CENTRE, RADIUS = np.array([0.7, -1.2, 2.5]), 0.2  # as in conftest.py
BOX = (*(CENTRE - 0.23), *(CENTRE + 0.23))


@pytest.mark.parametrize("method", ["volfus", "tvl1"])
@pytest.mark.parametrize("box", [BOX, None], ids=["box", "largest"])
def test_a_sphere_comes_back_within_a_voxel(scan: Path, tmp_path: Path, method: str,
                                            box: tuple[float, ...] | None) -> None:
    mesh = run_fuse("unused", str(scan), out=tmp_path / "mesh.ply", box=box, method=method, resolution=64)
    voxel = mesh.region.size / 64
    written = trimesh.load(tmp_path / "mesh.ply")
    np.testing.assert_allclose(written.vertices, mesh.vertices)
    off = np.abs(np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS)
    assert off.max() < 1.0 * voxel  # nothing of the box at its side, nothing of what was not seen
    assert np.ptp(mesh.vertices, axis=0).min() > 2 * RADIUS - 2 * voxel  # all of it
    outwards = written.face_normals @ CENTRE - np.einsum("ij,ij->i", written.face_normals,
                                                         written.triangles_center)
    assert (outwards < 0).all()


def test_the_largest_object_is_the_sphere(scan: Path) -> None:
    region = largest_object(read_scan(scan).views)
    low, high = np.array(region.low), np.array(region.high)
    assert (low < CENTRE - RADIUS).all() and (high > CENTRE + RADIUS).all()
    assert (high - low < 2 * RADIUS + 0.12).all()


def test_moving_and_scaling_the_scan_moves_and_scales_the_mesh(scan: Path) -> None:
    views = read_scan(scan, every=3).views
    region = Region.of_box(BOX)
    whole = Baseline(32)
    before = whole(DepthPyramid(views), region)[32]
    scale, shift = 3.0 / region.size, -np.array(region.centre)
    T = scale * (views.T - np.einsum("vij,j->vi", views.R, shift))
    moved = Views(views.depth * np.float32(scale), views.K, views.R, T)
    after = whole(DepthPyramid(moved), Region.of_cube((0.0, 0.0, 0.0), 3.0))[32]
    differ = np.abs(before.to_dense() - after.to_dense()) > 1e-3
    assert differ.mean() < 1e-3  # pixels that rounding decides


def test_the_network_gets_the_histograms_of_the_region(scan: Path, network: OctNetFusion) -> None:
    views, region = read_scan(scan).views, Region.of_box(BOX)
    octrees = Learned(network, (32, 64))(DepthPyramid(views), region)
    inputs = [OctreeBatch.from_grids([fuse_histogram(views, resolution, region.size, centre=region.centre)])
              for resolution in (32, 64)]
    reached = network(inputs)
    for resolution, one in zip((32, 64), reached, strict=True):
        expected = one.to_dense().clamp(-1, 1)[0].detach().numpy()
        np.testing.assert_allclose(octrees[resolution].to_dense(), expected, atol=1e-5)


def test_what_was_not_seen_is_cut_off_unless_it_is_asked_for(scan: Path) -> None:
    half = read_scan(scan, every=24)  # one view
    region = Region.of_box(BOX)
    seen = fuse_scan(half, Baseline(32), region=region)
    closed = fuse_scan(half, Baseline(32), region=region, keep_unseen=True)
    assert len(closed.faces) > 1.5 * len(seen.faces)
    off = np.abs(np.linalg.norm(seen.vertices - CENTRE, axis=1) - RADIUS)
    assert off.max() < 2.2 * region.size / 32 < np.abs(
        np.linalg.norm(closed.vertices - CENTRE, axis=1) - RADIUS).max()


def test_observed_by_hand() -> None:
    depth = np.zeros((1, 9, 9), np.float32)
    depth[0, 2, 2], depth[0, 6, 6] = 2.0, np.inf
    views = Views(depth, np.array([[1.0, 0, 4], [0, 1, 4], [0, 0, 1]]), np.eye(3)[None], np.zeros((1, 3)))
    on = np.array([-4.0, -4.0, 2.0])  # projects to (2, 2)
    cases = [(on, True), (on * 1.04, True), (on * 1.1, False), (on * 0.9, False), (on * -1, False),
             (on - [-2, 2, 0], True), (on - [-4, 0, 0], False),  # a pixel, and two pixels off
             (on * [-1, -1, 1], False), (on * [9, 1, 1], False), (on * [0, 0, 1], False)]
    found = observed(np.array([point for point, _ in cases]), views, 0.1)
    assert found.tolist() == [expected for _, expected in cases]


def test_frames_that_all_look_away_are_said_to(scan: Path, tmp_path: Path) -> None:
    read = read_scan(scan)
    away = Views(read.views.depth, read.views.K, np.diag([-1.0, 1, -1]) @ read.views.R,
                 read.views.T * [-1, 1, -1])
    with pytest.raises(OcnfError, match="no frame looks at it"):
        fuse_scan(replace(read, views=away), Baseline(32), region=Region.of_box(BOX))
    assert looked_at(read.views, Region.of_box(BOX)) and not looked_at(away, Region.of_box(BOX))


def test_a_warning_is_printed_before_what_it_explains_fails(scan: Path, tmp_path: Path) -> None:
    console = Console(record=True, width=400, file=io.StringIO())
    with pytest.raises(OcnfError, match="no surface was found"):
        run_fuse("unused", str(scan), out=tmp_path / "mesh.ply", box=BOX, method="volfus", resolution=32,
                 console=console, reading={"pose_scale": 30.0})
    assert "Note: neighbouring frames hardly overlap" in console.export_text()


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_colour_reaches_the_vertices_of_the_file(scan: Path, tmp_path: Path, suffix: str) -> None:
    folder = tmp_path / "coloured"
    shutil.copytree(scan, folder)
    for file in list(folder.glob("*.depth.png")):
        image = np.full((240, 320, 3), (10, 120, 200), np.uint8)  # blue, green, red
        cv2.imwrite(str(file).replace(".depth.", ".color."), image)
    out = tmp_path / f"mesh{suffix}"
    mesh = run_fuse("unused", str(folder), out=out, box=BOX, method="volfus", resolution=32,
                    reading={"frames": "4"})
    assert mesh.colours is not None and len(mesh.colours) == len(mesh.vertices)
    written = trimesh.load(out, process=False)
    assert len(written.vertices) == len(mesh.vertices)
    np.testing.assert_array_equal(written.visual.vertex_colors[:, :3],
                                  np.tile([200, 120, 10], (len(mesh.vertices), 1)))


def test_bad_input(scan: Path, tmp_path: Path) -> None:
    out = tmp_path / "mesh.ply"
    cases = [
        ({"box": (1, 0, 0, 0, 1, 1)}, "not a box"),
        ({"box": (50, 50, 50, 51, 51, 51)}, "no surface was found in the region"),
        ({"resolution": 60}, "multiple of 8"),
        ({"method": "magic"}, "no such method"),
        ({"method": "ours", "run": str(tmp_path / "none")}, "no such run"),
        ({"out": tmp_path / "mesh.jpg"}, "cannot be written in this format"),
        ({"scan": str(tmp_path / "none")}, "no such scan"),
    ]
    for change, message in cases:
        asked = {"run": "unused", "scan": str(scan), "out": out, "method": "volfus", "resolution": 32,
                 **change}
        with pytest.raises(OcnfError, match=message):
            run_fuse(**asked)
    assert not out.exists()
    blank = read_scan(scan)
    with pytest.raises(OcnfError, match="nothing was measured"):
        largest_object(blank.views.with_depth(np.zeros_like(blank.views.depth)))
