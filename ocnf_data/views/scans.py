"""Posed depth scans: what a user has of a scene, from whatever it is stored in, as `Views`.

`read_scan` is the one way in. It knows two formats, and a third is a function more in `_READERS`:

    FILE.h5::KEY    rendered views, as `generate` keeps them (`ocnf_data.views.store`)
    FOLDER          *intrinsics*.txt          3x3, pixels, for all frames
                    frame-NAME.depth.png      16-bit, millimetres; 0 and 65535 are no measurement
                    frame-NAME.pose.txt       4x4, camera to world, metres

A pixel without a measurement becomes 0, never a free ray: a camera that measures nothing has not looked far.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.arrays import F32, F64, U16
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import storage_errors
from ocnf_data.views.cameras import Views, check_rotation
from ocnf_data.views.store import read_kept

_DEPTH, _POSE = ".depth.png", ".pose.txt"
_NO_MEASUREMENT = 65535  # some writers mean this, others 0
_METRES = np.float32(1e-3)
_MAX_TEXT = 65_536  # bytes; sixteen numbers take less
_MAX_IMAGE = 2**27  # bytes
_MAX_PIXELS = 2**26
_MAX_FRAMES = 20_000
_MAX_BYTES = 2**34  # of depth as float32: 14,000 frames at 640x480


@dataclass(frozen=True)
class Scan:
    """Posed depth of a scene.

    Attributes:
        views: depth in metres, 0 where there is no measurement.
        names: of the V frames.
        cube: (centre (x, y, z), size) in metres of the space that the views were made for, where it is known.
        notes: what was left out, a sentence each.
    """

    views: Views
    names: tuple[str, ...]
    cube: tuple[tuple[float, float, float], float] | None = None
    notes: tuple[str, ...] = ()


def read_scan(place: str | os.PathLike[str], *, every: int = 1) -> Scan:
    """Read a scan of any format that is known here.

    Args:
        place: `FILE.h5::KEY` or a folder.
        every: take every n-th frame only.

    Raises:
        OcnfError: nothing there (`missing`), no frame that can be used (`empty`), or one that is wrong, with
            its file: it is never left out in silence.
    """
    if every < 1:
        raise OcnfError("not a step", where="read_scan", field="every", found=every, expected="1 or more")
    text = os.fspath(place)
    path, _, key = text.partition("::")
    for fits, read in _READERS:
        if fits(path, key):
            return read(text, every)
    if not Path(text).exists():
        raise OcnfError("no such scan", code="missing", where=text)
    raise OcnfError("not a scan", where=text, expected="a folder of frames, or FILE.h5::KEY")


# ---- FILE.h5::KEY


def _is_kept(path: str, key: str) -> bool:
    return bool(key) or path.endswith((".h5", ".hdf5"))


def _read_kept(place: str, every: int) -> Scan:
    kept = read_kept(place)
    chosen = range(0, len(kept.views), every)
    return Scan(kept.views.subset(chosen), tuple(f"view {i}" for i in chosen),
                cube=((0.0, 0.0, 0.0), kept.extent))


# ---- a folder of frames


def _is_folder(path: str, key: str) -> bool:
    return not key and Path(path).is_dir()


def _read_folder(place: str, every: int) -> Scan:
    folder = Path(place)
    with storage_errors(folder):
        files = {file.name: file for file in folder.iterdir() if file.is_file()}
    K = _intrinsics(folder, [files[name] for name in sorted(files) if "intrinsics" in name])
    depths, poses = _stems(files, _DEPTH), _stems(files, _POSE)
    if not depths:
        raise OcnfError("holds no frames", code="empty", where=folder, expected=f"frame-*{_DEPTH}")
    notes = [f"{name}: a depth map without a pose, left out" for name in sorted(depths - poses)]
    notes += [f"{name}: a pose without a depth map, left out" for name in sorted(poses - depths)]
    names, R, T = [], [], []
    for name in sorted(depths & poses)[::every]:
        pose = _pose(files[name + _POSE])
        if pose is None:
            notes.append(f"{name}: the pose is not known (NaN or infinite), left out")
            continue
        names.append(name)
        R.append(pose[:3, :3].T)
        T.append(-pose[:3, :3].T @ pose[:3, 3])
    if not names:
        raise OcnfError("no frame can be used", code="empty", where=folder, found="; ".join(notes))
    depth = _read_depths([files[name + _DEPTH] for name in names])
    return Scan(Views(depth, K, np.array(R), np.array(T)), tuple(names), notes=tuple(notes))


def _stems(files: dict[str, Path], suffix: str) -> set[str]:
    return {name.removesuffix(suffix) for name in files
            if name.startswith("frame-") and name.endswith(suffix)}


def _intrinsics(folder: Path, candidates: list[Path]) -> F64:
    texts = [file for file in candidates if file.suffix == ".txt"]
    if len(texts) != 1:
        raise OcnfError("the folder has to have one file of intrinsics", where=folder,
                        code="invalid" if texts else "missing",
                        found=", ".join(file.name for file in texts) or "none",
                        expected="a .txt with `intrinsics` in its name, 3x3 numbers in pixels")
    K = _matrix(texts[0], 3)
    fits = np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0
    if not fits or not np.array_equal(K * [[0, 1, 0], [1, 0, 0], [1, 1, 1]], np.diag([0.0, 0.0, 1.0])):
        raise OcnfError("not a pinhole's intrinsics", where=texts[0], found=K.tolist(),
                        expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
    return K


def _pose(file: Path) -> F64 | None:
    """Camera to world (4, 4), its rotation made exactly orthonormal; None for one that says it is unknown."""
    pose = _matrix(file, 4)
    if not np.isfinite(pose).all():
        return None
    if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        raise OcnfError("the last row of a pose is 0 0 0 1", where=file, found=pose[3].tolist())
    check_rotation(pose[None, :3, :3], where=file)
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right
    return pose


def _matrix(file: Path, n: int) -> F64:
    """Read n x n numbers of a text file, whatever the line breaks."""
    with storage_errors(file), file.open("rb") as opened:
        text = opened.read(_MAX_TEXT + 1)
    try:
        numbers = [float(word) for word in text.decode("ascii").split()]
    except ValueError as error:  # UnicodeDecodeError is one
        raise OcnfError("not a file of numbers", where=file, code="unreadable", expected=f"{n}x{n}",
                        found=text[:40]) from error
    if len(numbers) != n * n or len(text) > _MAX_TEXT:
        raise OcnfError("wrong size of matrix", where=file, found=f"{len(numbers)} numbers",
                        expected=f"{n}x{n}")
    return np.array(numbers).reshape(n, n)


def _read_depths(files: list[Path]) -> F32:
    """(V, H, W) float32 metres."""
    first = _image(files[0])
    if len(files) > _MAX_FRAMES or first.size * 4 * len(files) > _MAX_BYTES:
        raise OcnfError("too many frames to hold in memory", code="too_large", where=files[0].parent,
                        found=f"{len(files)} of {first.shape}", fix="take every n-th")
    depth = np.empty((len(files), *first.shape), np.float32)
    for i, file in enumerate(files):
        image = first if i == 0 else _image(file)
        if image.shape != first.shape:
            raise OcnfError("frames differ in size", where=file, found=image.shape, expected=first.shape)
        depth[i] = image * _METRES
        depth[i][image == _NO_MEASUREMENT] = 0
    return depth


def _image(file: Path) -> U16:
    try:
        import cv2
    except ImportError as error:
        raise OcnfError("reading PNG needs OpenCV", code="missing_extra",
                        fix="pip install 'ocnf[generate]'") from error
    with storage_errors(file), file.open("rb") as opened:
        data = opened.read(_MAX_IMAGE)
    _check_png(file, data)
    try:
        image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise OcnfError("not a readable PNG", code="damaged", where=file) from error
    if image is None:
        raise OcnfError("not a readable PNG", code="damaged", where=file)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise OcnfError("not a depth map", where=file, found=f"{image.dtype} {image.shape}",
                        expected="one channel of 16 bits, millimetres")
    return np.ascontiguousarray(image)


def _check_png(file: Path, data: bytes) -> None:
    """Refuse what OpenCV would decode in part without a word, or allocate too much for.

    A PNG is a signature and chunks: length, name, content, CRC-32 of name and content; IEND is the last.
    """
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise OcnfError("not a PNG", code="unreadable", where=file)
    at, name = 8, b""
    while name != b"IEND":
        length = int.from_bytes(data[at : at + 4], "big")
        name, end = data[at + 4 : at + 8], at + 8 + length
        crc = int.from_bytes(data[end : end + 4], "big")
        if len(data) < end + 4 or zlib.crc32(data[at + 4 : end]) != crc:
            raise OcnfError("the PNG is cut off or damaged", code="damaged", where=file)
        at = end + 4
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if not 0 < width * height <= _MAX_PIXELS:
        raise OcnfError("impossible size of image", where=file, found=f"{width}x{height}",
                        expected=f"at most {_MAX_PIXELS} pixels")


_READERS: list[tuple[Callable[[str, str], bool], Callable[[str, int], Scan]]] = [
    (_is_kept, _read_kept),
    (_is_folder, _read_folder),
]
"""(does the format fit `PATH`, `KEY`?, read it), tried in order."""
