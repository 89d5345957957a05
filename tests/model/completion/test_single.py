"""One's own depth map: the table is found wherever the world lies, and what is completed moves with it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from ocnf_data.errors import OcnfError
from ocnf_data.render import render_depth
from ocnf_data.shapes.primitives import box, join
from ocnf_data.views.cameras import Views
from ocnf_data.views.rigs import intrinsics
from ocnf_model.cli import app
from ocnf_model.completion.predict import CompletionNetwork
from ocnf_model.completion.single import complete_view
from ocnf_model.completion.synthetic import synthetic_tabletops
from ocnf_model.completion.table import VOXEL, find_table
from ocnf_model.completion.visible import LOWEST

K = intrinsics(286.0, 286.0, 160.0, 120.0)
SIZE = (240, 320)


@pytest.fixture(scope="module")
def network() -> CompletionNetwork:
    return CompletionNetwork("pretrained", "cpu")


def turned(view: Views, seed: int) -> tuple[Views, np.ndarray]:
    """The view in another world, and the (4, 4) motion from the old one to that."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, rng.normal(size=3) * 5
    back = np.linalg.inv(motion)
    return Views(view.depth, view.K, view.R @ back[:3, :3], view.R @ back[:3, 3] + view.T), motion


def look_down(parts: list, pitch: float = 40.0, wall: float | None = None) -> Views:
    """A view of a table at z = 0 with things on it, 1.1 m away, from above by `pitch` degrees."""
    things = [box(2.4, 1.4, 0.05).move(z=-0.05), *parts]
    if wall is not None:
        things.append(box(4.0, 0.02, 3.0).move(y=wall))
    whole = join(things)
    a = np.radians(pitch)
    R = np.array([[1, 0, 0], [0, -np.sin(a), -np.cos(a)], [0, np.cos(a), -np.sin(a)]])[None]
    T = np.array([[0.0, 0.0, 1.1]]) - R[0] @ [0, 0, 0.1]
    depth = render_depth(whole.vertices, whole.faces, K, R, T, SIZE)
    return Views(np.where(np.isfinite(depth), depth, 0), K, R, T)


@pytest.mark.parametrize("seed", range(4))
def test_the_table_of_a_noisy_frame_is_found_in_any_world(seed: int) -> None:
    scene = synthetic_tabletops(7, seed, views=1)[0]  # its table is at (LOWEST - 1) * VOXEL, z up
    view, motion = turned(scene.view, seed)
    grid = find_table(view)
    assert np.allclose(grid.to_grid[:3, :3] @ grid.to_grid[:3, :3].T, np.eye(3), atol=1e-9)
    up = grid.to_grid[2, :3] @ motion[:3, :3]
    assert np.degrees(np.arccos(min(up[2], 1.0))) < 1.0
    height, width = (n * scene.voxel for n in scene.shape[1:])
    middle = motion @ [width / 2, height / 2, (LOWEST - 1) * VOXEL, 1]
    assert abs((grid.to_grid @ middle)[2] - (LOWEST - 1) * VOXEL) < 0.008
    at = grid.place(view)
    assert np.allclose(at.R @ grid.to_grid[:3, :3], view.R)
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert np.allclose(grid.leave(points @ grid.to_grid[:3, :3].T + grid.to_grid[:3, 3]), points)


@pytest.mark.parametrize("pitch", [20.0, 40.0, 75.0])
@pytest.mark.parametrize("wall", [None, 0.71, 0.55])
def test_the_grid_is_around_the_things_and_no_wall_is_one(pitch: float, wall: float | None) -> None:
    parts = [box(0.1, 0.1, 0.2).move(x=-0.12), box(0.08, 0.12, 0.1).move(x=0.03)]
    grid = find_table(look_down(parts, pitch, wall))
    assert np.allclose(grid.to_grid[:3, :3], np.eye(3), atol=0.01)
    corner = -grid.to_grid[:2, 3]
    size = np.array(grid.shape[:0:-1]) * VOXEL
    assert abs(corner[0] - (-0.17 - 0.15)) < 0.02 and abs(corner[0] + size[0] - (0.07 + 0.15)) < 0.02
    assert -0.06 - 0.15 - 0.02 < corner[1] < corner[1] + size[1] < 0.06 + 0.15 + 0.02


def small_thing_alone(view: Views) -> bool:
    """Whether the grid is that around a thing of 6 cm in the middle of the table."""
    grid = find_table(view)
    size = np.array(grid.shape[:0:-1]) * VOXEL
    return bool(np.allclose(grid.to_grid[:3, :3], np.eye(3), atol=0.02) and (np.abs(size - 0.36) < 0.06).all()
                and np.allclose(-grid.to_grid[:2, 3] + size / 2, 0, atol=0.04))


def test_a_board_behind_the_things_is_none_of_them() -> None:
    """It has more pixels in the middle of the picture than they have, but is taller than things are."""
    assert small_thing_alone(look_down([box(0.06, 0.06, 0.06), box(0.6, 0.02, 0.9).move(y=0.35)], 30))


def test_what_is_in_the_middle_of_the_picture_is_taken() -> None:
    assert small_thing_alone(look_down([box(0.06, 0.06, 0.06), box(0.08, 0.1, 0.1).move(x=-0.4)], 45))


def test_a_wall_larger_than_the_table_is_not_taken_for_it() -> None:
    view = look_down([box(0.06, 0.06, 0.06)], 15, wall=0.3)
    assert (np.abs(view.depth[0] - np.median(view.depth[0])) < 0.3).mean() > 0.5  # most of it is wall
    assert small_thing_alone(view)


def at_origin(depth: np.ndarray) -> Views:
    return Views(depth, K, np.eye(3)[None], np.zeros((1, 3)))


@pytest.mark.parametrize(("view", "code", "message"), [
    (lambda: look_down([]), "empty", "nothing stands on the table"),
    (lambda: look_down([box(1.02, 0.1, 0.2)], 60), "too_large",
     "what stands on the table does not fit into the network's grid"),
    (lambda: at_origin(np.zeros((1, 8, 8))), "empty", "too little was measured"),
    (lambda: at_origin(np.random.default_rng(0).uniform(0.5, 3, (1, 80, 80))), "empty", "no table was found"),
])
def test_what_has_no_things_on_a_table_is_refused(view, code: str, message: str) -> None:
    with pytest.raises(OcnfError, match=f"frame 3: {message}") as refused:
        find_table(view(), "frame 3")
    assert refused.value.code == code


def test_what_is_completed_moves_with_the_world(network: CompletionNetwork, tmp_path: Path) -> None:
    view = look_down([box(0.12, 0.12, 0.2).turn("z", 30)])
    moved, motion = turned(view, 3)
    first, second = complete_view(network, view), complete_view(network, moved)
    assert first.grid.shape == second.grid.shape
    there = first.vertices @ motion[:3, :3].T + motion[:3, 3]
    assert cKDTree(second.vertices).query(there)[0].max() < VOXEL / 2
    mesh = trimesh.Trimesh(first.vertices, first.faces, process=False)
    assert mesh.is_watertight and 0.5 < mesh.volume / (0.12 * 0.12 * 0.2) < 2
    assert first.occupied.sum() * VOXEL**3 == pytest.approx(mesh.volume, rel=0.1)
    inside = first.grid.leave(np.argwhere(first.occupied)[:, ::-1] * VOXEL + VOXEL / 2)
    assert np.abs(inside[:, :2]).max() < 0.2 and inside[:, 2].min() > 0 and inside[:, 2].max() < 0.3
    first.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as kept:
        assert np.array_equal(kept["probability"], first.probability) and kept["voxel"] == VOXEL
        assert np.array_equal(kept["occupied"], kept["probability"] * (np.arange(80) >= LOWEST)[:, None, None]
                              >= first.threshold)
    with pytest.raises(OcnfError, match="cannot be written in this format"):
        first.save(tmp_path / "a.xyz")
    with pytest.raises(OcnfError, match="completion starts from a single view"):
        complete_view(network, Views(np.repeat(view.depth, 2, 0), K, np.repeat(view.R, 2, 0),
                                     np.repeat(view.T, 2, 0)))


def test_the_command_completes_a_frame_of_a_scan(tmp_path: Path) -> None:
    view = look_down([box(0.12, 0.12, 0.2).turn("z", 30)])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = view.R[0].T, view.centres[0]
    scan = tmp_path / "scan"
    scan.mkdir()
    for name in ("000000", "000001"):
        cv2.imwrite(str(scan / f"frame-{name}.depth.png"), np.rint(view.depth[0] * 1000).astype(np.uint16))
        np.savetxt(scan / f"frame-{name}.pose.txt", pose)
    np.savetxt(scan / "camera-intrinsics.txt", K)
    out = tmp_path / "things.ply"
    command = ["complete", "frame", "pretrained", str(scan), "--out", str(out), "--device", "cpu"]
    done = CliRunner().invoke(app, [*command, "--frame", "1"])
    assert done.exit_code == 0, done.output
    assert "litres of things" in done.output.replace("\n", " ")
    mesh = trimesh.load(out, process=False)
    assert mesh.is_watertight and 0.5 < mesh.volume / (0.12 * 0.12 * 0.2) < 2
    for frame in ("2", "nobody"):
        refused = CliRunner().invoke(app, [*command, "--frame", frame])
        assert isinstance(refused.exception, OcnfError) and "no such frame" in str(refused.exception)
