"""A mesh that cannot be used costs one logged draw, and a folder full of them stops the run."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from torch.utils.data import DataLoader

from ocnf_data import SynthesisDataset
from ocnf_data.errors import OcnfError
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.shapes import make_shape

GOOD, N = 9, 60


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Good meshes, and one that is cut off."""
    root = tmp_path_factory.mktemp("meshes")
    for i in range(GOOD):
        shape = make_shape("table", 0, i, "train")
        (root / f"m{i}.off").write_bytes(WRITERS[".off"](shape.vertices, shape.faces))
    (root / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n")
    return root


def open_set(small, folder, **arguments):
    manifest = small({"samples_per_epoch": N}, source={"kind": "folder", "shares": {"train": 1.0}})
    return SynthesisDataset(manifest, [16], "tsdf", **{
        "meshes": folder, "batch_size": 3, "rank": 0, "world_size": 1, "max_bad_fraction": 0.5, **arguments})


def test_another_draw_takes_its_place(small, folder, caplog):
    dataset = open_set(small, folder)
    with caplog.at_level(logging.WARNING):
        batches = list(dataset)
    lost = [one for batch in batches for one in batch.lost]
    assert lost
    assert {one.key for one in lost} == {"bad.off"}
    assert all(one.code == lost[0].code and "bad.off" in one.error for one in lost)
    assert sum(map(len, batches)) == N
    assert not any("bad" in key for batch in batches for key in batch.keys)
    assert [again for batch in batches for again in batch.repeat] == [False] * N
    assert len(dataset.lost(0)) == len(lost)  # a bad mesh is one of ten, so twice in a row is rare
    assert len([row for row in caplog.records if "bad.off" in row.getMessage()]) == len(dataset.lost(0))


def test_what_takes_its_place_is_the_same_with_workers(small, folder):
    alone, dataset = open_set(small, folder), open_set(small, folder)
    wanted = [(batch.keys, [one.key for one in batch.lost], batch.arena.numpy().tobytes()) for batch in alone]
    loader = DataLoader(dataset, batch_size=None, num_workers=2)
    assert [(batch.keys, [one.key for one in batch.lost], batch.arena.numpy().tobytes())
            for batch in loader] == wanted
    assert dataset.lost(0) == alone.lost(0)


def test_the_other_samples_are_what_they_were_without_it(small, folder, tmp_path):
    """A bad mesh changes no sample but its own; only the number of files to draw from counts."""
    good = list(open_set(small, folder))
    mended = tmp_path / "mended"
    mended.mkdir()
    for path in folder.iterdir():
        (mended / path.name).write_bytes(path.read_bytes())
    (mended / "bad.off").write_bytes((folder / "m0.off").read_bytes())
    whole = list(open_set(small, mended))
    same = [a.meta == b.meta and np.array_equal(a.arena.numpy(), b.arena.numpy())
            for a, b in zip(good, whole, strict=True)]
    assert [not batch.lost for batch in good] == same


def test_too_many_stop_the_run(small, folder):
    with pytest.raises(OcnfError, match=r"too many bad.*at most 1\b") as caught:
        list(open_set(small, folder, max_bad_fraction=0.0))
    assert caught.value.code == "too_many_bad"


def test_on_error_raise_stops_at_the_first(small, folder):
    with pytest.raises(OcnfError, match=r"bad\.off"):
        list(open_set(small, folder, on_error="raise"))


def test_a_file_that_changed_since_it_was_opened_is_a_bad_mesh(small, folder, tmp_path):
    for i in range(2):
        (tmp_path / f"m{i}.off").write_bytes((folder / f"m{i}.off").read_bytes())
    dataset = open_set(small, tmp_path, max_bad_fraction=1.0)
    (tmp_path / "m1.off").write_bytes((folder / "m5.off").read_bytes())
    lost = [one for batch in dataset for one in batch.lost]
    assert lost
    assert {(one.key, one.code) for one in lost} == {("m1.off", "changed")}


def test_nothing_but_bad_meshes_is_an_error_not_an_endless_loop(small, tmp_path):
    (tmp_path / "bad.off").write_text("OFF\n")
    with pytest.raises(OcnfError, match=r"bad\.off") as caught:
        next(iter(open_set(small, tmp_path, max_bad_fraction=1.0)))
    assert caught.value.code == "too_many_bad"


def test_missing_meshes_and_categories_are_named(small, folder, tmp_path):
    with pytest.raises(OcnfError, match="--meshes"):
        open_set(small, None)
    with pytest.raises(OcnfError, match="not there"):
        open_set(small, tmp_path / "nowhere")
    with pytest.raises(OcnfError, match="unicorn"):
        SynthesisDataset(small(), [16], "tsdf", categories=["chair", "unicorn"])
