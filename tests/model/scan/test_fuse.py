"""A scan comes back as a surface where it was, in the scan's coordinates."""

from __future__ import annotations

import io
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy.optimize import linprog

from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid, fuse_histogram
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import Scan, read_scan
from ocnf_data.views.scans.vertex_colour import vertex_colours
from ocnf_model import OctNetFusion, OctreeBatch
from ocnf_model.scan.fuse import fuse_scan
from ocnf_model.scan.fusers import Baseline, Learned
from ocnf_model.scan.outputs import save_tsdf
from ocnf_model.scan.region import Region, largest_object, looked_at, observed
from ocnf_model.scan.run import Asked, run_fuse

CENTRE, RADIUS = np.array([0.7, -1.2, 2.5]), 0.2  # as in conftest.py
BOX = (*(CENTRE - 0.23), *(CENTRE + 0.23))


@pytest.mark.parametrize("method", ["volfus", "tvl1"])
@pytest.mark.parametrize("box", [BOX, None], ids=["box", "largest"])
def test_a_sphere_comes_back_within_a_voxel(scan: Path, tmp_path: Path, method: str,
                                            box: tuple[float, ...] | None) -> None:
    mesh, = run_fuse(str(scan), Asked(tmp_path / "mesh.ply", methods=[method], box=box, resolution=64))
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


@pytest.mark.parametrize("voxel", [None, 0.009])
@pytest.mark.parametrize("truncation_voxels", [32 / 15, 6.0])
def test_the_truncation_is_the_networks(truncation_voxels, voxel, tmp_path: Path) -> None:
    """A network that copies plain fusion, before a plane: what is saved are its distances in metres."""
    views = Views(np.ones((1, 96, 128), np.float32), np.array([[100.0, 0, 64], [0, 100, 48], [0, 0, 1]]),
                  np.eye(3)[None], np.zeros((1, 3)))
    network = OctNetFusion("tsdf", levels=1, channels=(2, 4, 8), blend=True).eval().requires_grad_(False)
    network.levels[0].blend.begin_at(0.9999)
    fuser = Learned(network, (64,), truncation_voxels)
    mesh = fuse_scan(Scan(views, ("a",)), fuser, region=Region.of_box((-0.3, -0.3, 0.7, 0.3, 0.3, 1.3)),
                     voxel=voxel)
    save_tsdf(mesh, tmp_path / "tsdf.npz")
    with np.load(tmp_path / "tsdf.npz") as file:
        tsdf, first, edge, truncation = (file[name] for name in ("tsdf", "first", "voxel", "truncation"))
    assert truncation == pytest.approx(truncation_voxels * edge)
    ray = tsdf[:, tsdf.shape[1] // 2, tsdf.shape[2] // 2]
    ahead = 1 - (first[2] + edge * np.arange(len(ray)))
    near = np.abs(ahead) < 0.9 * truncation
    assert near.sum() >= 3
    np.testing.assert_allclose(ray[near] * truncation, ahead[near], atol=0.01 * edge)


@pytest.mark.parametrize("resolutions", [(32,), (32, 64)])
def test_a_network_that_reads_what_is_finer_gets_it(resolutions, scan: Path) -> None:
    views, region = read_scan(scan).views, Region.of_box(BOX)
    torch.manual_seed(0)
    network = OctNetFusion(levels=3, channels=(2, 3, 4), finer=1).eval()
    octrees = Learned(network, resolutions)(DepthPyramid(views), region)
    assert tuple(octrees) == resolutions
    inputs = [OctreeBatch.from_grids([fuse_histogram(views, resolution, region.size, centre=region.centre)])
              for resolution in (32, 64)]
    for resolution, one in zip(resolutions, network.run(inputs, levels=len(resolutions)), strict=True):
        expected = one.reconstruction.to_dense().clamp(-1, 1)[0].detach().numpy()
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


@settings(max_examples=150, deadline=None)
@given(seed=st.integers(0, 10**6), reach=st.sampled_from([0.3, 3.0, 30.0]))
def test_whether_a_box_is_looked_at_is_what_linear_programming_says(seed: int, reach: float) -> None:
    """A point of the box that lies as far as possible within all four sides of the picture."""
    rng = np.random.default_rng(seed)
    K = np.array([[rng.uniform(20, 80), 0, rng.uniform(-10, 74)],
                  [0, rng.uniform(20, 80), rng.uniform(-10, 50)], [0, 0, 1]])
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R *= np.sign(np.linalg.det(R))
    T = rng.normal(size=3)
    size = rng.uniform(0.02, 1, 3) * reach
    low = rng.normal(size=3) * reach
    sides = np.array([K[0] + [0, 0, 0.5], [0, 0, 63.5] - K[0], K[1] + [0, 0, 0.5], [0, 0, 47.5] - K[1]])
    best = linprog([0, 0, 0, -1], np.hstack([-sides @ R, np.ones((4, 1))]), sides @ T,
                   bounds=[*zip(low, low + size, strict=True), (None, None)])
    assert best.status == 0
    assume(abs(best.fun) > 1e-6)
    views = Views(np.ones((1, 48, 64), np.float32), K[None], R[None], T[None])
    assert looked_at(views, Region.of_box([*low, *(low + size)])) == (best.fun < 0)


def test_a_box_much_larger_than_what_a_camera_sees_of_it_is_looked_at() -> None:
    views = Views(np.full((1, 96, 128), 0.35, np.float32),
                  np.array([[110.0, 0, 64], [0, 110, 48], [0, 0, 1]]), np.eye(3)[None], np.zeros((1, 3)))
    assert looked_at(views, Region.of_box((-3, -3, -5.6, 3, 3, 0.4)))


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


@pytest.mark.parametrize(("box", "printed"), [
    ((1234.5678, -0.0, 0.25, 1235.5, 3.0, 2.25), "box 1234.5678 0 0.25 1235.5 3 2.25"),
    ((0.1 + 0.2, -1 / 3, -7.0, 20.0, 1e-7, 7.0), "box 0.3 -0.3333 -7 20 0 7"),
    ((400.001234567, 0.0, 0.0, 400.009, 0.01, 0.02), "box 400.00123 0 0 400.009 0.01 0.02"),
    ((5123456.7891, -1e30, 0.0, 5123457.8, 1.0, 1.0), "box 5123456.7891 -1e+30 0 5123457.8 1 1"),
])
def test_the_printed_box_gives_the_region_again(box: tuple[float, ...], printed: str) -> None:
    region = Region.of_box(box)
    assert str(region) == printed
    again = Region.of_box([float(word) for word in printed.split()[1:]])
    np.testing.assert_allclose([*again.low, *again.high], box, atol=1e-3 * min(region.size, 0.1))


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
        run_fuse(str(scan), Asked(tmp_path / "mesh.ply", methods=["volfus"], box=BOX, resolution=32,
                                  reading={"pose_scale": 30.0}), console)
    assert "Warning: neighbouring frames hardly overlap" in console.export_text()


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_colour_reaches_the_vertices_of_the_file(scan: Path, tmp_path: Path, suffix: str) -> None:
    folder = tmp_path / "coloured"
    shutil.copytree(scan, folder)
    for file in list(folder.glob("*.depth.png")):
        image = np.full((240, 320, 3), (10, 120, 200), np.uint8)  # blue, green, red
        cv2.imwrite(str(file).replace(".depth.", ".color."), image)
    out = tmp_path / f"mesh{suffix}"
    mesh, = run_fuse(str(folder), Asked(out, methods=["volfus"], box=BOX, resolution=32,
                                        reading={"frames": "4"}))
    assert mesh.colours is not None and len(mesh.colours) == len(mesh.vertices)
    written = trimesh.load(out, process=False)
    if suffix == ".glb":  # of a file with a material, trimesh has them among the attributes
        colours = next(iter(written.geometry.values())).visual.vertex_attributes["color"]
        expected = _linear([200, 120, 10])
    else:
        colours, expected = written.visual.vertex_colors, [200, 120, 10]
    assert len(colours) == len(mesh.vertices)
    scale = 1 if colours.dtype == np.uint8 else 257
    np.testing.assert_allclose(colours[:, :3] / scale, np.tile(expected, (len(colours), 1)), atol=0.5)


def test_an_image_that_is_damaged_costs_its_frame_its_colour_and_nothing_else(scan: Path,
                                                                              tmp_path: Path) -> None:
    folder = tmp_path / "coloured"
    shutil.copytree(scan, folder)
    depths = sorted(folder.glob("*.depth.png"))
    rng = np.random.default_rng(0)
    for file in depths:
        cv2.imwrite(str(file).replace(".depth.", ".color."), rng.integers(0, 256, (240, 320, 3), np.uint8))
    damaged = [Path(str(file).replace(".depth.", ".color.")) for file in depths]
    asked = Asked(tmp_path / "mesh.ply", methods=["volfus,tvl1"], box=BOX, resolution=32)
    for n in (1, len(depths)):
        for file in damaged[:n]:
            file.write_bytes(file.read_bytes()[:2000])
        console = Console(record=True, width=400, file=io.StringIO())
        meshes = run_fuse(str(folder), asked, console)
        said = f"{n} of {len(depths)} frames are without their colour ({damaged[0]}: the PNG is cut off"
        assert console.export_text().count(f"Note: {said}") == 1
        for mesh in meshes:
            assert any(note.startswith(said) for note in mesh.notes)
            assert (mesh.colours is None) == (n == len(depths))
            assert len(trimesh.load(tmp_path / f"mesh-{mesh.method}.ply").faces) == len(mesh.faces)
    read = read_scan(folder)
    with pytest.raises(OcnfError, match="cut off or damaged"):
        vertex_colours(meshes[0].vertices, read, 0.01)


def _linear(colour: list[int]) -> list[int]:
    """Bytes of sRGB in linear light, by its definition."""
    share = np.array(colour) / 255
    return np.rint(255 * np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)).tolist()


@pytest.mark.parametrize(("change", "message"), [
    ({"box": (1, 0, 0, 0, 1, 1)}, "not a box"),
    ({"box": (50, 50, 50, 51, 51, 51)}, "no frame looks at it"),
    ({"box": (0.7, -1.2, 2.6, 0.72, -1.18, 2.62)}, "no surface was found in the region"),  # inside the sphere
    ({"box": BOX, "room": True}, "cannot both be fused"),
    ({"resolution": 60}, "multiple of 8"),
    ({"methods": ["volfus,magic"]}, "no such method"),
    ({"methods": []}, "no method"),
    ({"methods": ["network"], "run": "none-such"}, "no such run"),
    ({"out": Path("mesh.jpg")}, "cannot be written in this format; found .jpg, expected .ply, .obj, .glb"),
    ({"out": Path("mesh")}, "found no suffix"),
    ({"out": None}, "nothing to make"),
    ({"out": None, "preview": Path("a.png"), "tsdf": Path("a.oc")}, "without a mesh to write"),
    ({"out": Path("/proc/mesh.ply")}, "/proc/mesh.ply"),
    ({"tsdf": Path("tsdf.vdb")}, r"expected .npz, .oc"),
    ({"picture": Path("picture.jpg")}, "expected .png"),
    ({"voxel": 0.0}, "not the size of a voxel"),
    ({"voxel": float("nan")}, "not the size of a voxel"),
    ({"voxel": 1.0, "box": BOX}, "too large for the region"),
    ({"voxel": 1e-6, "box": BOX}, r"would not fit into memory.*Take --voxel"),
    ({"max_depth": 0.5}, "nothing was measured as near as this"),
    ({"max_depth": -1.0}, "not a depth"),
    ({"faces": 1}, "not a number of faces"),
    ({"reading": {"frames": "25"}}, "the scan has fewer frames"),
    ({"reading": {"frames": "20:30"}}, "the scan has fewer frames"),
    ({"reading": {"frames": "30:40"}}, "the scan has fewer frames"),
])
def test_what_cannot_be_fused_is_said_and_nothing_written(scan: Path, tmp_path: Path, change: dict,
                                                          message: str, monkeypatch: pytest.MonkeyPatch,
                                                          ) -> None:
    monkeypatch.chdir(tmp_path)
    asked = {"out": Path("mesh.ply"), "methods": ["volfus"], "resolution": 32, **change}
    with pytest.raises(OcnfError, match=message):
        run_fuse(str(scan), Asked(**asked), Console(file=io.StringIO()))
    assert not list(tmp_path.iterdir())


def test_bad_input(scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OcnfError, match="no such scan"):
        run_fuse(str(tmp_path / "none"), Asked(tmp_path / "mesh.ply", methods=["volfus"]))
    with pytest.raises(OcnfError, match="is a folder"):
        (tmp_path / "folder.ply").mkdir()
        run_fuse(str(scan), Asked(tmp_path / "folder.ply", methods=["volfus"]))
    with monkeypatch.context() as patched, pytest.raises(OcnfError, match=r"old\.ply: the file is read-only"):
        (tmp_path / "old.ply").write_text("kept")
        patched.setattr("os.access", lambda *_: False)  # whoever runs the tests, who may be root
        run_fuse(str(scan), Asked(tmp_path / "old.ply", methods=["volfus"]))
    assert (tmp_path / "old.ply").read_text() == "kept"
    blank = read_scan(scan)
    with pytest.raises(OcnfError, match="nothing was measured"):
        largest_object(blank.views.with_depth(np.zeros_like(blank.views.depth)))
