"""Depth through OpenGL, with pyrender on EGL (headless, the default on Linux) or OSMesa.

The obvious calls give silently wrong depth; what is done here instead, and why:

- pyrender's depth-only path culls back faces whatever one asks for, and real meshes are wound inconsistently:
  every face is sent with both windings.
- On EGL it reads depth from a multisampled buffer, off the pixel centre, unless the flag SEG is set, which
  draws nothing without a seg_node_map. OSMesa has no such buffer, and DEPTH_ONLY is enough.
- OpenGL's pixel centres lie at +0.5, ours on integers: the principal point moves by half a pixel.
- The depth buffer has 24 bits, most of them spent near the near plane: near and far are put tightly around
  what each view shows. A camera inside its scene has to live with the error, up to `6e-8 z^2 / near`.
- Positions are float32 on the device: they are sent relative to the middle of the mesh.
- pyrender has been seen to leak with every mesh: the context is made again every few of them.

One process, one thread: a context cannot be used from a second thread or across a fork.
"""

from __future__ import annotations

import os
import sys
import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ocnf_data.arrays import F32, F64, I64
from ocnf_data.errors import OcnfError

_MESHES_PER_CONTEXT = 16
_MARGIN = 1e-3  # share of the depth range that near and far stay away from the mesh
_GL_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera looks along -z with y up

MISSING = "pip install 'ocnf[gl]'"
LIBRARIES = "apt-get install libegl1 libgl1 libxrender1"
OSMESA = "apt-get install libosmesa6 && pip install --no-deps PyOpenGL==3.1.10"


def render_pyrender(
    vertices: F64, faces: I64, K: F64, R: F64, T: F64, size: tuple[int, int], near: float = 1e-3
) -> F32:
    """Depth (V, H, W) float32, z in metres, inf where nothing is hit; arguments as for `raster.rasterise`.

    Raises:
        OcnfError: pyrender or OpenGL is missing or fails, or a second thread or a forked process uses it.
    """
    depth = np.full((len(R), *size), np.inf, dtype=np.float32)
    if len(faces) == 0:
        return depth
    pyrender = _import_pyrender()
    context = _context_for(size, pyrender)
    used = vertices[np.unique(faces)]
    middle = (used.min(axis=0) + used.max(axis=0)) / 2
    mesh = pyrender.Mesh([pyrender.Primitive(
        positions=vertices - middle, indices=np.concatenate([faces, faces[:, ::-1]]).astype(np.uint32)
    )])
    scene = pyrender.Scene()
    drawn = scene.add(mesh)
    flags = pyrender.RenderFlags.DEPTH_ONLY
    if os.environ.get("PYOPENGL_PLATFORM") != "osmesa":
        flags |= pyrender.RenderFlags.SEG
    camera = None
    for view in range(len(R)):
        z = used @ R[view, 2] + T[view, 2]
        if z.max() <= near:
            continue
        if camera is not None:
            scene.remove_node(camera)
        camera = scene.add(
            pyrender.IntrinsicsCamera(
                K[view, 0, 0], K[view, 1, 1], K[view, 0, 2] + 0.5, K[view, 1, 2] + 0.5,
                znear=max(near, z.min() * (1 - _MARGIN)), zfar=z.max() * (1 + _MARGIN),
            ),
            pose=_camera_pose(R[view], T[view] + R[view] @ middle),
        )  # fmt: skip
        image = context.draw(scene, flags, {drawn: (255, 255, 255)})
        depth[view] = np.where(image == 0, np.float32(np.inf), image)
    return depth


def close() -> None:
    """Free the OpenGL context that this process keeps between calls; the next call makes a new one."""
    global _context
    if _context is not None:
        _context.renderer.delete()
    _context = None


@dataclass
class _Context:
    """An OpenGL context with the process and thread that it belongs to."""

    renderer: Any
    size: tuple[int, int]
    meshes_left: int = _MESHES_PER_CONTEXT
    process: int = field(default_factory=os.getpid)
    thread: int = field(default_factory=threading.get_ident)

    def check_owner(self) -> None:
        """Refuse what would hang or crash: a context inherited by a fork or borrowed by a thread."""
        if self.process != os.getpid():
            raise OcnfError("this process was forked from one that had opened OpenGL", code="gl",
                            where="pyrender", fix="start workers by spawn instead, as loky does")
        if self.thread != threading.get_ident():
            raise OcnfError("OpenGL was opened by another thread", code="gl", where="pyrender",
                            fix="render from one thread only, and use processes to render in parallel")

    def draw(self, scene: Any, flags: int, seg_node_map: dict[Any, tuple[int, int, int]]) -> F32:
        """One depth image (H, W), 0 where nothing was drawn."""
        try:
            image: F32 = self.renderer.render(scene, flags=flags, seg_node_map=seg_node_map)
        except Exception as error:  # whatever PyOpenGL raises, from GLError to AttributeError
            raise _broken("OpenGL failed to draw", error) from error
        return image


_context: _Context | None = None


def _context_for(size: tuple[int, int], pyrender: Any) -> _Context:
    """The context for images of this size (H, W), with room for one more mesh."""
    global _context
    if _context is not None:
        _context.check_owner()
        if _context.size != size or _context.meshes_left == 0:
            close()
    if _context is None:
        try:
            _context = _Context(pyrender.OffscreenRenderer(size[1], size[0]), size)
        except Exception as error:  # whatever PyOpenGL raises, from AssertionError to ctypes' ArgumentError
            raise _broken("OpenGL gives no context", error) from error
    _context.meshes_left -= 1
    return _context


def _import_pyrender() -> Any:
    # Read by PyOpenGL and by Mesa when they are first used; a user's own choice stands. Mesa's software
    # renderer would otherwise start a thread for every core in every worker process.
    if sys.platform == "linux":
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
        os.environ.setdefault("LP_NUM_THREADS", "0")
    try:
        import pyrender
    except ModuleNotFoundError as error:
        raise OcnfError(f"the module {error.name} is not installed", code="gl", where="pyrender",
                        fix=f"use the backend raster, or install it:\n{MISSING}") from error
    except Exception as error:  # PyOpenGL without its library: ImportError, AttributeError, OSError ...
        raise _broken("OpenGL cannot be loaded", error) from error
    return pyrender


def _broken(what: str, error: Exception) -> OcnfError:
    platform = os.environ.get("PYOPENGL_PLATFORM", "the screen")
    fix = OSMESA if platform == "osmesa" else LIBRARIES
    return OcnfError(f"{what} on {platform}", code="gl", where="pyrender",
                     found=f"{type(error).__name__}: {error}", fix=f"run {fix}, or use the backend raster")


def _camera_pose(R: F64, T: F64) -> F64:
    """Camera to world (4, 4) in OpenGL's camera axes."""
    pose = np.eye(4)
    pose[:3, :3] = R.T
    pose[:3, 3] = -R.T @ T
    return pose @ _GL_CAMERA
