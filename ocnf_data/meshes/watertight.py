"""Any mesh to a watertight one: seen from 80 sides, fused into a TSDF, and cut out of it by marching cubes.

What no camera sees becomes solid: cavities and hidden parts are gone, open boxes are filled only as far as
they cannot be looked into. Winding does not matter. Sheets without thickness get one, of about a voxel.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy.typing as npt

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.interrupts import ignore_interrupts, joblib_results
from ocnf_data.files.storage import Store
from ocnf_data.fusion import fuse_tsdf
from ocnf_data.meshes.formats import FORMATS
from ocnf_data.meshes.listing import is_hidden
from ocnf_data.meshes.normalise import fit_cube
from ocnf_data.meshes.read import read_mesh
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.octree.surface import octree_surface
from ocnf_data.render import checked_mesh, render_depth
from ocnf_data.views import rigs
from ocnf_data.views.cameras import Views

DEFAULT_LEVEL = 0.25
_EXTENT = _DISTANCE = 3.0  # metres, of the paper's cube and rig
_FOCAL, _WIDTH, _HEIGHT = 351.0, 640, 480  # pixels; at 256^3 a pixel is about a voxel wide


def make_watertight(vertices: npt.ArrayLike, faces: npt.ArrayLike, resolution: int = 256,
                    level: float = DEFAULT_LEVEL) -> tuple[F64, I64]:
    """A closed surface around a mesh, in the mesh's own coordinates.

    Args:
        vertices: (N, 3) in any unit; the longest edge of their box may have any length.
        faces: (M, 3) indices.
        resolution: voxels along the cube, a multiple of 8; the box's longest edge takes 95 % of them.
        level: how far outside of the measured surface to cut, in units of tau = 2.13 voxels. The default,
            half a voxel, keeps sheets and wires whole; 0 moves nothing, and tears them.

    Returns:
        vertices (N, 3) and faces (M, 3): every edge belongs to two faces, which look outwards.

    Raises:
        OcnfError: arrays that are not those of a mesh, `degenerate` for one without extent, `empty` for one
            without faces and where nothing is thick enough to be solid.
    """
    points, triangles = checked_mesh(vertices, faces, "make_watertight")
    if len(triangles) == 0:
        raise OcnfError("has no faces", code="empty", where="make_watertight",
                        found=f"{len(points)} vertices")
    cube = fit_cube(points, triangles, _EXTENT)
    zoom = -(-resolution // 256)  # finer voxels need finer pixels
    size = (zoom * _HEIGHT, zoom * _WIDTH)
    K = rigs.intrinsics(zoom * _FOCAL, zoom * _FOCAL, size[1] / 2, size[0] / 2)
    R, T = rigs.look_from(rigs.published80(), _DISTANCE)
    depth = render_depth(cube.apply(points), triangles, K, R, T, size=size)
    octree = fuse_tsdf(Views(depth, K, R, T), resolution, _EXTENT)
    surface, surface_faces = octree_surface(octree, _EXTENT, level)
    if len(surface_faces) == 0:
        raise OcnfError("nothing is thick enough to be solid at this resolution", code="empty",
                        found=resolution, fix="raise the resolution or the level")
    return cube.invert(surface), surface_faces


@dataclass
class WatertightReport:
    """What `watertight_path` did."""

    written: list[Path] = field(default_factory=list)
    failures: list[tuple[Path, OcnfError]] = field(default_factory=list)


def watertight_path(source: str | os.PathLike[str], out: str | os.PathLike[str], resolution: int = 256,
                    jobs: int = 1, level: float = DEFAULT_LEVEL, suffix: str = ".ply",
                    progress: Callable[[int, int], None] | None = None) -> WatertightReport:
    """Make one mesh file, or all in a folder and the folders in it, watertight.

    Args:
        source: a mesh file, or a folder. Hidden files and folders in it are passed over, and so is `out`
            where it lies in it.
        out: the file to write if `source` is a file (its suffix names the format; without a suffix it is a
            folder). If `source` is a folder, the folder in which the same tree of names appears.
        resolution: voxels along the cube, a multiple of 8, as for `make_watertight`.
        jobs: worker processes.
        level: how far outside of the measured surface to cut, in units of tau, as for `make_watertight`.
        suffix: format of what is written into a folder: .ply, .obj, .off or .stl.
        progress: called with (done, all) after every file.

    Returns:
        The report: a file that cannot be used is a failure in it and does not stop the others.

    Raises:
        OcnfError: the source is missing or holds no mesh, or the format cannot be written.
    """
    if resolution % 8 or not 8 <= resolution <= 1024:  # said once, not of every file
        raise OcnfError("not a resolution", field="resolution", found=resolution,
                        expected="a multiple of 8 from 8 to 1024")
    tasks = _tasks(Path(source), Path(out), suffix)
    report = WatertightReport()
    for done, (path, target, error) in enumerate(_run(tasks, resolution, level, jobs), 1):
        if error is None:
            report.written.append(target)
        else:
            report.failures.append((path, error))
        if progress is not None:
            progress(done, len(tasks))
    report.written.sort()
    report.failures.sort(key=lambda row: row[0])
    return report


def _tasks(source: Path, out: Path, suffix: str) -> list[tuple[Path, Path]]:
    """Which file goes where; files of one folder whose names differ in the suffix alone keep it."""
    if not source.exists():
        raise OcnfError("no such file or folder", code="missing", where=source)
    if not source.is_dir():
        to_folder = out.is_dir() or out.suffix == ""
        tasks = [(source, out / f"{source.stem}{suffix}" if to_folder else out)]
    else:
        paths = _meshes_in(source, out)
        if not paths:
            raise OcnfError("holds no mesh", code="empty", where=source, expected=", ".join(FORMATS))
        stems = [p.with_suffix("") for p in paths]
        names = [p if stems.count(stem) > 1 else stem for p, stem in zip(paths, stems, strict=True)]
        tasks = [(path, out / f"{name.relative_to(source)}{suffix}")
                 for path, name in zip(paths, names, strict=True)]
    for path, target in tasks:
        if target.suffix.lower() not in WRITERS:
            raise OcnfError("cannot be written in this format", where=target, found=target.suffix,
                            expected=", ".join(WRITERS))
        if target.resolve() == path.resolve():
            raise OcnfError("would overwrite its own source", where=target, fix="name another output")
    return tasks


def _meshes_in(source: Path, out: Path) -> list[Path]:
    """The mesh files in a folder and the folders in it, less what is hidden and what lies in `out`."""
    base, made = source.resolve(), out.resolve()
    if base == made:
        raise OcnfError("is the folder of the meshes: what is written would be read the next time", where=out,
                        fix="name another output")
    within = made.is_relative_to(base)  # not where `source` lies in `out`: that may hold it
    found = sorted((p.relative_to(source) for p in source.rglob("*")
                    if p.suffix.lower() in FORMATS and p.is_file()), key=lambda p: p.as_posix())
    return [source / p for p in found
            if not any(map(is_hidden, p.parts)) and not (within and (base / p).is_relative_to(made))]


def _run(tasks: list[tuple[Path, Path]], resolution: int, level: float,
         jobs: int) -> Iterator[tuple[Path, Path, OcnfError | None]]:
    if jobs == 1 or len(tasks) == 1:
        yield from (_one(path, target, resolution, level) for path, target in tasks)
        return
    try:
        import joblib
        from joblib.externals.loky import get_reusable_executor
    except ImportError as error:
        raise missing_extra("several jobs need joblib", "generate") from error
    # loky gives each worker its share of the cores' threads.
    parallel = joblib.Parallel(n_jobs=min(jobs, len(tasks)), backend="loky", return_as="generator_unordered")
    calls = [joblib.delayed(_in_worker)(path, target, resolution, level) for path, target in tasks]
    finished = False
    try:
        with joblib_results(functools.partial(parallel, calls)) as results:
            yield from results
        finished = True
    finally:
        if not finished:
            get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)


def _in_worker(path: Path, target: Path, resolution: int,
               level: float) -> tuple[Path, Path, OcnfError | None]:
    ignore_interrupts()
    return _one(path, target, resolution, level)


def _one(path: Path, target: Path, resolution: int, level: float) -> tuple[Path, Path, OcnfError | None]:
    try:
        mesh = read_mesh(path)
        vertices, faces = make_watertight(mesh.vertices, mesh.faces, resolution, level)
        data = WRITERS[target.suffix.lower()](vertices, faces)
        Store(target.parent).put_bytes(target.name, data)
    except OcnfError as error:
        return path, target, error
    return path, target, None
