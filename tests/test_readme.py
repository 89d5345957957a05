"""The Python that the README and the pages print runs as printed."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import yaml

from ocnf_data.generation import generate
from ocnf_data.manifest import Manifest
from ocnf_data.render import render_depth
from ocnf_data.views.rigs import intrinsics, look_from, rig_from_name
from ocnf_model.training.settings import read_settings

ROOT = Path(__file__).parent.parent


def blocks(page, word, language="python"):
    """The page's blocks of code in which a word occurs."""
    found = re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)
    return [block for block in found if word in block]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a data set named as in the README."""
    folder = tmp_path_factory.mktemp("readme")
    generate(Manifest.from_dict({
        "name": "small", "source": {"kind": "shapes", "categories": ["chair", "mug"], "counts": {"train": 3}},
        "camera": {"rig": "fibonacci8", "width": 64, "height": 48, "fx": 35, "fy": 35, "cx": 32, "cy": 24},
        "resolutions": [64, 128],
        "inputs": [{"name": "v2", "views": 2, "sigma": 0.02, "encodings": ["histogram"]}],
    }), folder / "OUT", progress=False)
    return folder


def run(code, folder):
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize("page", ["README.md", "docs/loading.md"])
def test_the_loader_goes_on_where_its_state_says(folder, page):
    [loading] = blocks(page, "dataset.state_dict(batch)")
    shapes = "print(*octrees.trees.shape, octrees.to_float().shape[1], len(truth.grids()), state['step'])"
    assert run(loading + shapes, folder) == ["4", "8", "8", "8", "2", "10", "4", "0"]


def test_webdataset_reads_the_shards(folder):
    [reading] = blocks("docs/loading.md", "webdataset")
    look = "for sample in samples: print(sample['v2-histogram-64.oct']['data'].shape[1])"
    assert run(reading + look, folder) == ["10"] * 3


def test_a_scan_as_the_page_lays_it_out_is_read_and_fused(tmp_path):
    """The wall lies at z = 0: free in front of it, hidden behind, and the surface where it should be."""
    [writing] = blocks("docs/scans.md", "read_scan")
    look = ("line = octree.to_dense()[0, :, 32, 32]\n"
            "print(len(views), *(f'{value:.3f}' for value in line[[8, 31, 32, 40]]))")
    assert run(writing + look, tmp_path) == ["2", "1.000", "0.156", "-0.156", "-1.000"]


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """A folder with a scan SCAN, and its frames as arrays: a ball of 0.4 m seen from eight sides."""
    folder = tmp_path_factory.mktemp("frames")
    scan = folder / "SCAN"
    scan.mkdir()
    K, size = intrinsics(120, 120, 47.5, 35.5), (72, 96)
    R, T = look_from(rig_from_name("fibonacci8"), 1.2)
    ball = trimesh.creation.icosphere(3, 0.4)
    depth = render_depth(ball.vertices, ball.faces, K, R, T, size)
    depth[np.isinf(depth)] = 0
    np.savetxt(scan / "camera-intrinsics.txt", K)
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R.transpose(0, 2, 1), -np.einsum("vji,vj->vi", R, T)
    for i in range(8):
        cv2.imwrite(str(scan / f"frame-{i}.depth.png"), (1000 * depth[i]).round().astype(np.uint16))
        np.savetxt(scan / f"frame-{i}.pose.txt", poses[i])
    np.savez(folder / "frames.npz", depth=depth, K=K, poses=poses)
    return folder


RADIUS = ("import numpy as np; radius = np.linalg.norm(result.vertices, axis=1); "
          "print(list(result.octrees), round(float(np.median(radius)), 2))")


def test_frames_become_a_surface_in_five_lines(frames):
    [code] = blocks("README.md", "load_network")
    assert len([line for line in code.splitlines() if line]) == 5
    assert "".join(run(code + RADIUS, frames)) == "[64,128,256]0.4"
    assert len(trimesh.load(frames / "mesh.ply").faces) > 10_000


def test_the_page_on_deploying_runs(frames):
    [code] = blocks("docs/deploy.md", "load_network")
    given = "import numpy as np; depth, K, poses = np.load('frames.npz').values()\n"
    (frames / "RUN").mkdir()
    shutil.copy(ROOT / "ocnf_model/pretrained/level-1.safetensors", frames / "RUN")  # nothing else is needed
    assert "".join(run(given + code + RADIUS, frames)) == "[64]0.4"


def test_a_mesh_becomes_octrees(tmp_path):
    """The cube's face x = 1 lies between the centres of voxels 52 (0.961 m) and 53 (1.008 m)."""
    [code] = blocks("docs/api/index.md", "render_depth")
    look = "line = truth.to_dense()[0, 32, 32]; print(line[32], line[52] < 0 < line[53] < 0.5, line[63])"
    assert run(code + look, tmp_path)[-3:] == ["-1.0", "True", "1.0"]


def test_the_smallest_manifest_is_one():
    [text] = blocks("docs/manifest.md", "name:", "yaml")
    assert Manifest.from_dict(yaml.safe_load(text)).source.kind == "folder"


def test_the_settings_that_the_page_prints_are_settings():
    [text] = blocks("docs/training.md", "stages:", "yaml")
    settings = read_settings(yaml.safe_load(text), "the page")
    assert settings.stage(0).batch_size == 4 and settings.stage(5).learning_rate == 5e-4
