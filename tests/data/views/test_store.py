"""Kept views come back bit for bit, for the right mesh and cameras, and from trusted files only."""

from __future__ import annotations

import dataclasses
import pickle
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.generation.fingerprint import view_fingerprint
from ocnf_data.manifest import Manifest
from ocnf_data.meshes import Normalisation
from ocnf_data.views.cameras import Views
from ocnf_data.views.rigs import fibonacci, intrinsics, look_from
from ocnf_data.views.store import KeptViews, ViewStore, read_kept

SHA, PRINT = "a" * 64, "b" * 64


def kept(v: int = 3, height: int = 6, width: int = 8, seed: int = 0) -> KeptViews:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 5, (v, height, width)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.4] = np.inf
    depth[rng.random(depth.shape) < 0.1] = 0
    R, T = look_from(fibonacci(v), 3.0)
    views = Views(depth, intrinsics(7.0, 8.0, 3.5, 2.5), R, T)
    return KeptViews(views, SHA, PRINT, Normalisation(rng.normal(size=3), 0.37), 3.0)


def assert_same(a: Views, b: Views) -> None:
    for name in ("depth", "K", "R", "T"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype and x.tobytes() == y.tobytes()


@settings(max_examples=20, deadline=None)
@given(v=st.integers(1, 5), height=st.integers(1, 9), width=st.integers(1, 9), seed=st.integers(0, 99))
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, v: int, height: int, width: int, seed: int
) -> None:
    folder, here = tmp_path_factory.mktemp("views"), kept(v, height, width, seed)
    ViewStore(folder).keep("chair_1", here)
    there = read_kept(f"{folder}/chair_1.h5::chair_1")
    assert_same(there.views, here.views)
    np.testing.assert_array_equal(there.normalisation.centre, here.normalisation.centre)
    assert there.normalisation.scale == here.normalisation.scale
    assert (there.mesh_sha256, there.fingerprint, there.extent) == (SHA, PRINT, 3.0)


def test_only_what_fits_is_found(tmp_path: Path) -> None:
    store, here = ViewStore(tmp_path / "views"), kept()
    assert store.find("a", SHA, PRINT) is None
    store.keep("a", here)
    found = store.find("a", SHA, PRINT)
    assert found is not None
    assert_same(found, here.views)
    assert store.find("a", "c" * 64, PRINT) is None
    assert store.find("a", SHA, "c" * 64) is None
    assert store.find("b", SHA, PRINT) is None
    store.keep("a", dataclasses.replace(here, mesh_sha256="c" * 64))  # the mesh has changed
    assert store.find("a", SHA, PRINT) is None and store.find("a", "c" * 64, PRINT) is not None
    assert [path.name for path in (tmp_path / "views").iterdir()] == ["a.h5"]


def test_on_s3(s3_url: str) -> None:
    here = kept()
    ViewStore(f"{s3_url}/set/views").keep("a", here)
    found = ViewStore(f"{s3_url}/set/views").find("a", SHA, PRINT)
    assert found is not None
    assert_same(found, here.views)
    assert_same(read_kept(f"{s3_url}/set/views/a.h5::a").views, here.views)


def test_the_fingerprint_is_of_what_is_rendered() -> None:
    base: dict[str, Any] = {
        "name": "x", "source": {"kind": "list", "items": {"train": ["a.obj"]}},
        "inputs": [{"name": "a", "views": 4, "sigma": 0.02, "encodings": ["tsdf"]}]}
    others: list[dict[str, Any]] = [
        {"camera": {"fx": 350}}, {"camera": {"rig": "icosphere1"}}, {"camera": {"distance": 4}},
        {"normalise": {"padding": 0.1}}, {"renderer": "pyrender"}]
    alike: list[dict[str, Any]] = [
        {"seed": 3}, {"name": "y"}, {"resolutions": [64]}, {"truncation_voxels": 3}, {"views": "keep"},
        {"inputs": [{"name": "b", "views": 6, "sigma": 0.0, "encodings": ["histogram"]}]}]
    own = view_fingerprint(Manifest.from_dict(base))
    assert all(view_fingerprint(Manifest.from_dict({**base, **change})) == own for change in alike)
    assert len({own, *(view_fingerprint(Manifest.from_dict({**base, **change})) for change in others)}) == 6


def test_the_same_bytes_at_any_time(tmp_path: Path) -> None:
    ViewStore(tmp_path / "a").keep("k", kept())
    time.sleep(1.1)  # HDF5's times have seconds
    ViewStore(tmp_path / "b").keep("k", kept())
    assert (tmp_path / "a/k.h5").read_bytes() == (tmp_path / "b/k.h5").read_bytes()


def test_an_exception_while_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(h5py.Group, "create_dataset", fail)
    with pytest.raises(OcnfError) as caught:
        ViewStore(tmp_path).keep("k", kept())
    assert caught.value.code == "disk_full"
    assert not list(tmp_path.iterdir())


def test_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ViewStore(tmp_path).keep("k", kept())
    assert_same(read_kept("k.h5::k").views, kept().views)
    assert_same(read_kept("k.h5").views, kept().views)
    with h5py.File("both.h5", "w") as file, h5py.File("k.h5") as one:
        for name in ("x", "y"):
            one.copy("k", file, name)
    assert_same(read_kept("./both.h5::y").views, kept().views)
    with pytest.raises(OcnfError, match=r"both\.h5.*several items"):
        read_kept("both.h5")
    with pytest.raises(OcnfError, match="one of x, y"):
        read_kept("both.h5::z")
    with pytest.raises(OcnfError, match="no such file"):
        read_kept("none.h5::k")
    with pytest.raises(OcnfError, match="not an item's key"):
        ViewStore(tmp_path).find("../k", SHA, PRINT)


def test_any_flipped_bit_and_any_cut_is_noticed(tmp_path: Path) -> None:
    """Or hits a byte that holds nothing: then what is read is what was written."""
    ViewStore(tmp_path).keep("k", kept())
    path = tmp_path / "k.h5"
    data, want = path.read_bytes(), kept()
    rng = random.Random(0)
    noticed = 0
    for position in rng.sample(range(len(data)), 400):
        flipped = bytes([data[position] ^ 1 << rng.randrange(8)])
        path.write_bytes(data[:position] + flipped + data[position + 1:])
        try:
            there = read_kept(f"{path}::k")
        except OcnfError:
            noticed += 1
        else:
            assert_same(there.views, want.views)
            assert (there.mesh_sha256, there.fingerprint) == (SHA, PRINT)
            assert (there.normalisation.scale, there.extent) == (want.normalisation.scale, want.extent)
            np.testing.assert_array_equal(there.normalisation.centre, want.normalisation.centre)
    assert noticed > 100
    for length in range(0, len(data), 97):
        path.write_bytes(data[:length])
        with pytest.raises(OcnfError):
            read_kept(f"{path}::k")


def _external_link(file: h5py.File) -> None:
    del file["k/depth"]
    file["k/depth"] = h5py.ExternalLink("/etc/passwd", "/depth")


def _soft_link(file: h5py.File) -> None:
    file.move("k/depth", "depth")
    file["k/depth"] = h5py.SoftLink("/depth")


def _group_link(file: h5py.File) -> None:
    file.move("k", "other")
    file["k"] = h5py.SoftLink("/other")


def _virtual(file: h5py.File) -> None:
    shape = file["k/depth"].shape
    del file["k/depth"]
    layout = h5py.VirtualLayout(shape, "<f4")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", shape)
    file["k"].create_virtual_dataset("depth", layout)


def _external_data(file: h5py.File) -> None:
    del file["k/T"]
    file["k"].create_dataset("T", (3, 3), "<f8", external=[("/etc/passwd", 0, 72)])


def _objects(file: h5py.File) -> None:
    del file["k/depth"]
    data = file["k"].create_dataset("depth", (3,), h5py.vlen_dtype(np.uint8))
    data[0] = np.frombuffer(pickle.dumps(print), np.uint8)


def _references(file: h5py.File) -> None:
    del file["k/T"]
    file["k"].create_dataset("T", (3, 3), h5py.ref_dtype)


def _gigabytes(file: h5py.File) -> None:
    del file["k/depth"]
    file["k"].create_dataset("depth", (60_000, 8000, 8000), "<f4", chunks=(1, 8000, 8000))


def _holes(file: h5py.File) -> None:
    del file["k/depth"]
    file["k"].create_dataset("depth", (3, 6, 8), "<f4", chunks=(1, 6, 8))[0] = 1.0


def _filter(file: h5py.File) -> None:
    del file["k/depth"]
    depth = kept().views.depth
    file["k"].create_dataset("depth", data=depth, chunks=(1, 6, 8), compression="lzf")


def _wrong_shape(file: h5py.File) -> None:
    del file["k/R"]
    file["k"].create_dataset("R", (2, 3, 3), "<f8", chunks=(2, 3, 3), data=np.zeros((2, 3, 3)))


def _negative_depth(file: h5py.File) -> None:
    file["k/depth"][0, 0, 0] = -1.0


def _not_a_rotation(file: h5py.File) -> None:
    file["k/R"][0] = np.ones((3, 3))


def _more(file: h5py.File) -> None:
    file["k"]["payload"] = np.zeros(3)


def _later(file: h5py.File) -> None:
    file["k"].attrs["format"] = np.int64(2)


def _string_scale(file: h5py.File) -> None:
    file["k"].attrs["scale"] = "1.0"


def _text_digest(file: h5py.File) -> None:
    file["k"].attrs["mesh_sha256"] = "a" * 64  # of variable length


def _no_depth(file: h5py.File) -> None:
    del file["k/depth"]


def _dataset_for_group(file: h5py.File) -> None:
    del file["k"]
    file["k"] = np.zeros(3)


@pytest.mark.parametrize(("spoil", "reason"), [
    (_external_link, "depth is a link"),
    (_soft_link, "depth is a link"),
    (_group_link, "k is a link"),
    (_virtual, "the data lies elsewhere"),
    (_external_data, "the data lies elsewhere"),
    (_objects, "wrong type of data"),
    (_references, "wrong type of data"),
    (_gigabytes, "size out of bounds"),
    (_holes, "chunks are missing"),
    (_filter, "unknown filters; found \\[32000\\]"),
    (_wrong_shape, "wrong shape"),
    (_negative_depth, "depth: depth is negative"),
    (_not_a_rotation, "not a rotation"),
    (_more, "unknown members; found payload"),
    (_later, "another format"),
    (_string_scale, "extent and scale"),
    (_text_digest, "mesh_sha256 is not a SHA-256"),
    (_no_depth, "depth is a link or missing"),
    (_dataset_for_group, "of the wrong kind"),
])
def test_a_hostile_file_is_refused(tmp_path: Path, spoil: Callable[[h5py.File], None], reason: str) -> None:
    ViewStore(tmp_path).keep("k", kept())
    with h5py.File(tmp_path / "k.h5", "a") as file:
        spoil(file)
    with pytest.raises(OcnfError, match=rf"k\.h5.*{reason}") as caught:
        read_kept(f"{tmp_path}/k.h5::k")
    assert caught.value.code == "damaged"


@pytest.mark.parametrize("content", [b"", b"not HDF5", b"\x89HDF\r\n\x1a\n" + bytes(200)])
def test_a_file_that_is_something_else(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "k.h5").write_bytes(content)
    with pytest.raises(OcnfError, match=r"k\.h5.*Delete it") as caught:
        ViewStore(tmp_path).find("k", SHA, PRINT)
    assert caught.value.code == "damaged"
