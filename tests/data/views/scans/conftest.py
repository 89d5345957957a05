"""One rendered scene, and writers of it in every format."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from ocnf_data.render import render_depth
from ocnf_data.shapes.primitives import box, join

SIZE = (48, 64)
K = np.array([[55.0, 0, 31.2], [0, 56.0, 23.4], [0, 0, 1]])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes
N = 5


@dataclass(frozen=True)
class Scene:
    """What was rendered: depth (V, H, W) metres, 0 where nothing is; poses (V, 4, 4) camera to world."""

    depth: np.ndarray
    poses: np.ndarray
    colour: np.ndarray

    def stored(self, i: int, units: float = 1000) -> np.ndarray:
        return np.rint(self.depth[i] * units).astype(np.uint16)


def look(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera to world, x right, y down, z towards the target; the world's z is up."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), position
    return pose


@pytest.fixture(scope="session")
def scene() -> Scene:
    """A corner of a room with two boxes in it, seen from five places on a curve that has no symmetry."""
    parts = [box(4, 4, 0.1).move(z=-0.1), box(0.1, 4, 2.5).move(x=-1.6), box(4, 0.1, 2.5).move(y=1.4),
             box(0.5, 0.4, 0.6).move(x=-0.3, y=0.4), box(0.3, 0.3, 1.1).turn("z", 30).move(x=0.5, y=0.7)]
    whole = join(parts)
    t = np.linspace(0, 1, N)
    positions = np.stack([1.0 + 0.5 * t, -1.3 + 0.4 * t**2, 0.9 + 0.3 * np.sin(2 * t)], axis=1)
    poses = np.stack([look(p, np.array([-0.1 + 0.2 * i / N, 0.5, 0.4])) for i, p in enumerate(positions)])
    R = poses[:, :3, :3].swapaxes(1, 2)
    T = -np.einsum("vij,vj->vi", R, poses[:, :3, 3])
    depth = render_depth(whole.vertices, whole.faces, K, R, T, SIZE)
    depth = np.where(np.isfinite(depth), depth, 0)
    depth[:, 3, 5] = 0
    rng = np.random.default_rng(0)
    return Scene(depth, poses, rng.integers(0, 256, (N, *SIZE, 3)).astype(np.uint8))


def png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[:, :, ::-1] if image.ndim == 3 else image)


def seven_scenes(scene: Scene, folder: Path) -> None:
    np.savetxt(folder / "camera-intrinsics.txt", K)
    for i in range(N):
        png(folder / f"frame-{i:06d}.depth.png", scene.stored(i))
        png(folder / f"frame-{i:06d}.color.png", scene.colour[i])
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", scene.poses[i])


def quaternion(R: np.ndarray) -> np.ndarray:
    """x, y, z, w by way of the eigenvector of Bar-Itzhack's matrix: another way than the reader's."""
    (a, b, c), (d, e, f), (g, h, i) = R
    matrix = np.array([[a - e - i, d + b, g + c, h - f], [d + b, e - a - i, h + f, c - g],
                       [g + c, h + f, i - a - e, d - b], [h - f, c - g, d - b, a + e + i]]) / 3
    return np.linalg.eigh(matrix)[1][:, -1]


def tum(scene: Scene, folder: Path) -> None:
    lists = {"depth.txt": ["# depth maps", "# timestamp filename"], "rgb.txt": [], "groundtruth.txt": ["# x"]}
    for i in range(N):
        time = 1305031102.16 + 0.1 * i
        png(folder / f"depth/{time:.6f}.png", scene.stored(i, 5000))
        png(folder / f"rgb/{time + 0.01:.6f}.png", scene.colour[i])
        lists["depth.txt"].append(f"{time:.6f} depth/{time:.6f}.png")
        lists["rgb.txt"].append(f"{time + 0.01:.6f} rgb/{time + 0.01:.6f}.png")
        q, p = quaternion(scene.poses[i][:3, :3]), scene.poses[i][:3, 3]
        for off, shift in ((-0.03, 7.0), (0.004, 0.0), (0.03, -7.0)):  # only the middle one is of this moment
            lists["groundtruth.txt"].append(" ".join(f"{v:.12g}" for v in (*(p + shift), *q)).join(
                [f"{time + off:.6f} ", ""]))
    for name, lines in lists.items():
        (folder / name).write_text("\n".join(lines) + "\n")
    np.savetxt(folder / "calibration.txt", [[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]])


def _open3d(scene: Scene, folder: Path) -> None:
    for i in range(N):
        png(folder / f"depth/{i + 1}.png", scene.stored(i))
        png(folder / f"color/{i + 1}.png", scene.colour[i])


def open3d_log(scene: Scene, folder: Path) -> None:
    _open3d(scene, folder)
    (folder / "intrinsic.json").write_text(json.dumps(
        {"width": SIZE[1], "height": SIZE[0], "intrinsic_matrix": K.T.ravel().tolist()}))
    blocks = [f"{i} {i} {i + 1}\n" + "\n".join(" ".join(f"{v:.12f}" for v in row) for row in pose)
              for i, pose in enumerate(scene.poses)]
    (folder / "scene").mkdir()
    (folder / "scene" / "trajectory.log").write_text("\n".join(blocks) + "\n")


def open3d_json(scene: Scene, folder: Path) -> None:
    _open3d(scene, folder)
    camera = {"class_name": "PinholeCameraIntrinsic", "width": SIZE[1], "height": SIZE[0],
              "intrinsic_matrix": K.T.ravel().tolist()}
    (folder / "trajectory.json").write_text(json.dumps({
        "class_name": "PinholeCameraTrajectory", "parameters": [
            {"class_name": "PinholeCameraParameters", "intrinsic": camera,
             "extrinsic": np.linalg.inv(pose).T.ravel().tolist()} for pose in scene.poses]}))


def transforms(scene: Scene, folder: Path) -> None:
    """Colour twice as large as depth; the intrinsics are the colour image's, with its own pixel centres."""
    frames = []
    for i in range(N):
        png(folder / f"depth/{i:05d}.png", scene.stored(i))
        png(folder / f"images/{i:05d}.png", scene.colour[i].repeat(2, axis=0).repeat(2, axis=1))
        frames.append({"file_path": f"images/{i:05d}.png", "depth_file_path": f"depth/{i:05d}.png",
                       "transform_matrix": (scene.poses[i] @ FLIP).tolist()})
    frames[1] |= {"fl_x": 2 * K[0, 0], "fl_y": 2 * K[1, 1], "cx": 2 * K[0, 2] + 1, "cy": 2 * K[1, 2] + 1}
    (folder / "transforms.json").write_text(json.dumps({
        "camera_model": "OPENCV", "w": 2 * SIZE[1], "h": 2 * SIZE[0], "fl_x": 2 * K[0, 0],
        "fl_y": 2 * K[1, 1], "cx": 2 * (K[0, 2] + 0.5), "cy": 2 * (K[1, 2] + 0.5), "frames": frames}))


def scannet(scene: Scene, folder: Path) -> None:
    for name in ("pose", "intrinsic"):
        (folder / name).mkdir()
    for i in range(N):
        png(folder / f"depth/{i * 5}.png", scene.stored(i))
        png(folder / f"color/{i * 5}.png", scene.colour[i])
        np.savetxt(folder / f"pose/{i * 5}.txt", scene.poses[i])
    np.savetxt(folder / "pose/100.txt", np.full((4, 4), -np.inf))
    png(folder / "depth/100.png", scene.stored(0))
    whole = np.eye(4)
    whole[:3, :3] = K
    for name in ("depth", "color"):
        np.savetxt(folder / "intrinsic" / f"intrinsic_{name}.txt", whole)


def voxlets(scene: Scene, folder: Path) -> None:
    for name in ("frames", "poses"):
        (folder / name).mkdir()
    for i in range(N):
        data = scene.stored(i).astype(">u2").tobytes()
        (folder / f"frames/{i:05d}.pgm").write_bytes(f"P5 {SIZE[1]} {SIZE[0]} 65535\n".encode() + data)
        png(folder / f"frames/{i:05d}.ppm", scene.colour[i])
        (folder / f"poses/{i:06d}.yaml").write_text(
            f"depth_scaling: 65.536\nimage: frames/{i:05d}.pgm\nrgb: frames/{i:05d}.ppm\n"
            f"intrinsics: {K.ravel().tolist()}\npose: {scene.poses[i].ravel().tolist()}\n")
    (folder / "tsdf_meta.yaml").write_text("shape: !!python/tuple [172, 128, 80]\nvoxelsize: 0.005\n")


WRITERS: dict[str, Callable[[Scene, Path], None]] = {
    "7scenes": seven_scenes, "tum": tum, "open3d": open3d_log, "open3d-json": open3d_json,
    "transforms": transforms, "scannet": scannet, "voxlets": voxlets}


@pytest.fixture
def write(scene: Scene, tmp_path: Path) -> Callable[[str], Path]:
    """`write(format)`: a new folder with the scene in it."""

    def writer(name: str) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        WRITERS[name](scene, folder)
        return folder

    return writer
