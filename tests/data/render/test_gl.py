"""The pyrender backend against the z-buffer, which the other tests hold to ray casting.

OpenGL decides pixels on an edge by its own rule and its depth has 24 bits, so a few silhouette pixels may
differ, and a surface seen at a grazing angle by a little: corners are snapped to 1/256 of a pixel. The bounds
here are far below what each of the traps named in `gl.py` costs, which is thousands of pixels a view.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from ocnf_data.errors import OcnfError
from ocnf_data.render import render_depth
from ocnf_data.views.rigs import fibonacci, intrinsics, look_from

Call = Callable[..., np.ndarray]
K, SIZE = intrinsics(300.0, 240.0, 141.3, 160.8), (240, 321)
R, T = look_from(fibonacci(4), 3.0)


def _scene() -> tuple[np.ndarray, np.ndarray]:
    """Closed, open and thin parts, half of the faces wound the wrong way."""
    rng = np.random.default_rng(0)
    ends = rng.uniform(-1, 1, (8, 2, 3))
    rods = [trimesh.creation.cylinder(0.006, segment=pair, sections=5) for pair in ends]
    sheet = trimesh.creation.icosphere(3)
    sheet.update_faces(sheet.triangles_center[:, 2] > 0.3)
    mesh = trimesh.util.concatenate([trimesh.creation.torus(0.9, 0.2), sheet, *rods])
    faces = np.array(mesh.faces)
    flip = rng.random(len(faces)) < 0.5
    faces[flip] = faces[flip][:, ::-1]
    return np.array(mesh.vertices), faces


def _differing(a: np.ndarray, b: np.ndarray, tolerance: float) -> np.ndarray:
    """Pixels a view (V,) that are hit in one only or differ by more than the tolerance in metres."""
    with np.errstate(invalid="ignore"):
        return ((np.isfinite(a) != np.isfinite(b)) | (np.abs(a - b) > tolerance)).sum(axis=(1, 2))


def test_agrees_with_the_z_buffer(gl_process: Call) -> None:
    vertices, faces = _scene()
    depth = gl_process(render_depth, vertices, faces, K, R, T, SIZE, backend="pyrender")
    expected = render_depth(vertices, faces, K, R, T, SIZE)
    assert depth.dtype == np.float32
    assert (_differing(depth, expected, 1e-3) <= 4).all()
    assert (_differing(depth, expected, 1e-5) <= 60).all()
    # Had the principal point not moved by half a pixel, or by the wrong sign, this many would differ.
    for du, dv in ((0.5, 0), (0, 0.5), (-0.5, 0), (0, -0.5)):
        shifted = intrinsics(300.0, 240.0, 141.3 + du, 160.8 + dv)
        assert (_differing(render_depth(vertices, faces, shifted, R, T, SIZE), expected, 1e-5) > 5000).all()


def test_far_from_the_origin(gl_process: Call) -> None:
    """Single precision is spent on the mesh, not on where it stands."""
    vertices, faces = _scene()
    away = np.array([1000.0, -2000.0, 500.0])
    depth = gl_process(render_depth, vertices + away, faces, K, R, T - R @ away, SIZE, backend="pyrender")
    assert (_differing(depth, render_depth(vertices, faces, K, R, T, SIZE), 1e-5) <= 60).all()


def test_camera_inside_the_scene(gl_process: Call) -> None:
    vertices, faces = _scene()
    near = 0.05
    R, T = look_from(fibonacci(4), 0.7)
    depth = gl_process(render_depth, vertices, faces, K, R, T, SIZE, backend="pyrender", near=near)
    expected = render_depth(vertices, faces, K, R, T, SIZE, near=near)
    assert (_differing(depth, expected, 1e-4) <= 12).all()


def test_nothing_in_sight(gl_process: Call) -> None:
    vertices, faces = _scene()
    behind, beside, nothing = (faces, [0, 0, -6]), (faces, [50, 0, 3]), (faces[:0], [0, 0, 3])
    for shown, t in (behind, beside, nothing):
        depth = gl_process(render_depth, vertices, shown, K, R[:1], np.array([t]), SIZE, backend="pyrender")
        assert np.isposinf(depth).all()


@pytest.fixture
def abuse(gl_process: Call) -> Callable[[str], Any]:
    """Run one of the scenarios of gl_child.py."""

    def run(scenario: str) -> Any:
        script = Path(__file__).with_name("gl_child.py")
        command = [sys.executable, str(script), scenario]
        return json.loads(subprocess.run(command, capture_output=True, check=True, timeout=120).stdout)

    return run


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_many_meshes(abuse: Callable[[str], Any]) -> None:
    report = abuse("meshes")
    assert report["same"]
    assert report["growth"] < 8  # MB; a leak of the meshes themselves would be 15


def test_threads_and_forks_are_refused(abuse: Callable[[str], Any]) -> None:
    assert "opened by another thread" in abuse("thread")
    assert "was forked" in abuse("fork")


def test_missing_pyrender_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrender", None)
    with pytest.raises(OcnfError, match=r"pip install 'ocnf\[gl\]'") as caught:
        render_depth(np.eye(3), [[0, 1, 2]], K, R, T, SIZE, backend="pyrender")
    assert caught.value.code == "gl"
