"""Rendered depth kept in HDF5 (`views: keep`), so that other noise levels and view counts need no rendering.

One file for each item, `<key>.h5`, so that workers never share one and a killed worker costs one item:

    /<key>                 attributes: format, mesh_sha256, fingerprint (ASCII), extent, scale (float64)
    /<key>/depth           (V, H, W) float32 metres, inf = free ray, 0 = no measurement; one chunk a view
    /<key>/K               (V, 3, 3) float64 pixels
    /<key>/R, /<key>/T     (V, 3, 3), (V, 3) float64, world to camera, metres
    /<key>/centre          (3,) float64: with `scale`, the mesh's normalisation, `(vertices - centre) * scale`

Depth is shuffled and deflated at level 1, which brings a checksum for every view; the other arrays have
Fletcher's, and the file format's version is one whose own structures have checksums: no flipped bit passes.
80 views of a ModelNet chair at 640x480 (98.3 MB): 5.4 MB, 0.19 s to write, 0.09 s to read; gzip 4 makes
it 10 % less in 1.5 times the time, lzf 12 % more in 0.7 times. Files with several keys are read too.

The numba rasteriser renders a mesh of ten thousand faces in less time than reading its views takes. Keeping
them pays where rendering is slow (pyrender, millions of faces) and where something else is to be done with
them, such as fusing them at another resolution.
"""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.views.cameras import Views
from ocnf_data.views.normalisation import Normalisation

if TYPE_CHECKING:
    import h5py

_FORMAT = 1
_KEY = re.compile(r"[A-Za-z0-9_-]+")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MAX_BYTES = 2**32  # of depth: 3,500 views at 640x480
_MAX_VIEWS = 65_536
# Deflate, shuffle, Fletcher-32. Any other filter could be a library that HDF5 loads from a search path.
_FILTERS = frozenset({1, 2, 3})
# What HDF5 raises on damaged files; MemoryError is not among them because sizes are checked first.
_HDF5_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, UnicodeError)


@dataclass(frozen=True)
class KeptViews:
    """The rendered views of a mesh, and what is needed to lead results back to it.

    Attributes:
        views: all views of the rig, without noise.
        mesh_sha256: SHA-256 of the mesh's file.
        fingerprint: `view_fingerprint` of the manifest they were rendered for.
        normalisation: the map from the mesh's own coordinates to the cube that the cameras look at.
        extent: edge length of that cube, metres.
    """

    views: Views
    mesh_sha256: str
    fingerprint: str
    normalisation: Normalisation
    extent: float


class ViewStore:
    """A folder (path or URL) of kept views."""

    def __init__(self, url: str | os.PathLike[str]) -> None:
        self._store = Store(url)

    def kept(self, keys: Collection[str]) -> list[str]:
        """The keys among `keys` that have a file of kept views, whatever the mesh and cameras."""
        names = set(self._store.list())
        return [key for key in keys if _file_name(key) in names]

    def fingerprint(self, key: str) -> str:
        """The `view_fingerprint` that an item's views were kept with."""
        with _opened(self._store, _file_name(key)) as file:
            return _text(_group(file, key), "fingerprint")

    def find(self, key: str, mesh_sha256: str, fingerprint: str) -> Views | None:
        """The views of an item; None where there are none, or they are of another mesh or other cameras.

        Raises:
            OcnfError: code `damaged` for a file that cannot be trusted.
        """
        name = _file_name(key)
        if not self._store.exists(name):
            return None
        with _opened(self._store, name) as file:
            group = _group(file, key)
            if _text(group, "mesh_sha256") != mesh_sha256 or _text(group, "fingerprint") != fingerprint:
                return None
            return _kept(group).views

    def keep(self, key: str, kept: KeptViews) -> None:
        """Write an item's views as a whole file, in place of one that is there."""
        with self._store.writing(_file_name(key)) as path, _hdf5().File(path, "w", libver="v110") as file:
            group = file.create_group(key)
            group.attrs["format"] = np.int64(_FORMAT)
            for text in ("mesh_sha256", "fingerprint"):
                group.attrs[text] = np.bytes_(getattr(kept, text))  # fixed length: no heap, no objects
            group.attrs["extent"] = np.float64(kept.extent)
            group.attrs["scale"] = np.float64(kept.normalisation.scale)
            views = kept.views
            group.create_dataset("depth", data=views.depth, chunks=(1, *views.size), shuffle=True,
                                 compression="gzip", compression_opts=1)
            for name, array in (("K", views.K), ("R", views.R), ("T", views.T),
                                ("centre", kept.normalisation.centre)):
                data = np.asarray(array, dtype=np.float64)
                group.create_dataset(name, data=data, chunks=data.shape, fletcher32=True)


def read_kept(place: str) -> KeptViews:
    """What is kept at `FILE.h5::KEY`; the key may be left out where the file holds one only.

    Raises:
        OcnfError: no such file or key (`missing`), not such a file, or a hostile one (`damaged`).
    """
    path, _, key = place.partition("::")
    folder, slash, name = path.rpartition("/")
    with _opened(Store((folder or "/") if slash else "."), name) as file:
        if not key:
            names = list(file)
            if len(names) != 1:
                raise OcnfError("holds the views of several items", code="missing", where=path,
                                found=f"{len(names)} keys", fix=f"name one of them: {path}::KEY")
            key = names[0]
        return _kept(_group(file, key))


def _file_name(key: str) -> str:
    if not _KEY.fullmatch(key):
        raise OcnfError("not an item's key", where="views", found=repr(key),
                        expected="letters, digits, _ and -")
    return f"{key}.h5"


def _hdf5() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise missing_extra("kept views need h5py, which is not installed", "fuse") from error
    return h5py


@contextmanager
def _opened(store: Store, name: str) -> Iterator[h5py.File]:
    """The HDF5 file; every failure inside the block is one of the file's."""
    hdf5 = _hdf5()
    where = store.where(name)
    path = store.local_path(name)
    if path is not None:
        with storage_errors(where), path.open("rb"):  # a clear reason before HDF5 gives its own
            pass
    source = io.BytesIO(_bounded(store, name)) if path is None else path
    try:
        # No lock: network file systems often have none, and a file under its name never changes.
        with hdf5.File(source, "r", locking=False) as file:
            yield file
    except _HDF5_ERRORS as error:
        raise OcnfError(f"not a readable file of views ({error})", code="damaged", where=where,
                        fix="delete it; the next run renders those views again") from error


def _bounded(store: Store, name: str) -> bytes:
    size = store.size(name)
    if size > _MAX_BYTES:
        raise _hostile(store.where(name), "too large", size, f"at most {_MAX_BYTES} bytes")
    return store.read_bytes(name)


def _group(file: h5py.File, key: str) -> h5py.Group:
    if not _KEY.fullmatch(key) or key not in file:
        names = ", ".join(sorted(map(str, file))[:10])
        raise OcnfError("no views of that item", code="missing", where=file.filename, field=key,
                        expected=f"one of {names}")
    group = _member(file, key, _hdf5().Group)
    version = group.attrs["format"] if _is_number(group, "format") else None
    if version != _FORMAT:
        raise _hostile(_where(group), "another format of kept views", version, _FORMAT)
    return group


def _kept(group: h5py.Group) -> KeptViews:
    where = _where(group)
    unknown = set(group) - {"depth", "K", "R", "T", "centre"}
    if unknown:
        raise _hostile(where, "unknown members", ", ".join(sorted(unknown)), "depth, K, R, T, centre")
    depth = _dataset(group, "depth", "<f4")
    if depth.ndim != 3 or depth.chunks != (1, *depth.shape[1:]):
        raise _hostile(where, "depth has the wrong layout", (depth.shape, depth.chunks), "a chunk a view")
    v = depth.shape[0]
    K, R, T, centre = (_dataset(group, name, "<f8", shape) for name, shape in (
        ("K", (v, 3, 3)), ("R", (v, 3, 3)), ("T", (v, 3)), ("centre", (3,))))
    numbers = {name: float(group.attrs[name]) for name in ("extent", "scale") if _is_number(group, name)}
    if len(numbers) != 2 or not all(math.isfinite(x) and x > 0 for x in numbers.values()):
        raise _hostile(where, "extent and scale are not positive numbers", numbers, "two of them")
    try:
        views = Views(_read(depth), _read(K), _read(R), _read(T))
    except OcnfError as error:
        raise _hostile(where, f"{error.field}: {error.what}", error.found, error.expected) from error
    return KeptViews(
        views=views,
        mesh_sha256=_text(group, "mesh_sha256"),
        fingerprint=_text(group, "fingerprint"),
        normalisation=Normalisation(_read(centre), numbers["scale"]),
        extent=numbers["extent"],
    )


def _member(group: h5py.Group, name: str, kind: type) -> Any:
    """A member that lies in this file itself: soft and external links could lead anywhere."""
    hdf5 = _hdf5()
    if not isinstance(group.get(name, getlink=True), hdf5.HardLink):
        raise _hostile(_where(group), f"{name} is a link or missing", None, "data in this file")
    member = group[name]
    if not isinstance(member, kind):
        raise _hostile(_where(group), f"{name} is of the wrong kind", type(member).__name__, kind.__name__)
    return member


def _dataset(group: h5py.Group, name: str, dtype: str, shape: tuple[int, ...] | None = None) -> h5py.Dataset:
    """A dataset that is plain numbers of a bounded size, all of them stored in this file."""
    dataset = _member(group, name, _hdf5().Dataset)
    where = _where(dataset)
    if dataset.dtype != np.dtype(dtype) or dataset.dtype.metadata:
        raise _hostile(where, "wrong type of data", dataset.dtype, np.dtype(dtype))
    if shape is not None and dataset.shape != shape:
        raise _hostile(where, "wrong shape", dataset.shape, shape)
    if not dataset.shape or not 0 < dataset.shape[0] <= _MAX_VIEWS or not 0 < dataset.nbytes <= _MAX_BYTES:
        raise _hostile(where, "size out of bounds", dataset.shape, f"1 to {_MAX_BYTES} bytes")
    properties = dataset.id.get_create_plist()
    if dataset.is_virtual or properties.get_external_count() or dataset.chunks is None:
        raise _hostile(where, "the data lies elsewhere", None, "chunks in this file")
    filters = {properties.get_filter(i)[0] for i in range(properties.get_nfilters())}
    if not filters <= _FILTERS:
        raise _hostile(where, "unknown filters", sorted(filters - _FILTERS), "deflate, shuffle, Fletcher-32")
    n_chunks = math.prod(-(-n // chunk) for n, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    if dataset.id.get_num_chunks() != n_chunks:  # those not stored would read as zeros
        raise _hostile(where, "chunks are missing", dataset.id.get_num_chunks(), n_chunks)
    return dataset


def _read(dataset: h5py.Dataset) -> npt.NDArray[Any]:
    data = np.empty(dataset.shape, dataset.dtype)
    dataset.read_direct(data)
    return data


def _text(group: h5py.Group, name: str) -> str:
    """A SHA-256 among the attributes, stored as a string of fixed length."""
    value = group.attrs[name] if name in group.attrs and group.attrs.get_id(name).dtype == "S64" else b""
    text = value.decode("ascii") if isinstance(value, bytes) else ""
    if not _DIGEST.fullmatch(text):
        raise _hostile(_where(group), f"{name} is not a SHA-256", value, "64 hexadecimal digits")
    return text


def _is_number(group: h5py.Group, name: str) -> bool:
    if name not in group.attrs:
        return False
    attribute = group.attrs.get_id(name)
    return attribute.shape == () and attribute.dtype in (np.dtype("<i8"), np.dtype("<f8"))


def _where(thing: h5py.Group | h5py.Dataset) -> str:
    return f"{thing.file.filename}::{str(thing.name).lstrip('/')}"


def _hostile(where: str, what: str, found: object, expected: object) -> OcnfError:
    return OcnfError(what, code="damaged", where=where, found=found, expected=expected)
