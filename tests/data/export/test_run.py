"""A whole data set: every sample accounted for, resumable, with one process or several."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.export import export_dataset
from ocnf_data.files.storage import Store
from ocnf_data.manifest import Manifest
from ocnf_data.shards import load_dataset, write_dataset


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(folder.rglob("*")) if path.is_file()}


def test_what_is_there_is_kept_and_the_rest_is_made(shapes: Store, tmp_path: Path) -> None:
    out = tmp_path / "out"
    calls: list[tuple[int, int]] = []
    report = export_dataset(shapes.url, out, "dense", resolution=32, limit=1,
                            progress=lambda done, total: calls.append((done, total)))
    assert (report.written, report.kept) == (2, 0) and calls == [(1, 2), (2, 2)]
    assert report.size == sum(len(data) for name, data in files(out).items() if name.endswith(".npz"))
    assert str(report).startswith("2 samples = 2 written + 0 kept + 0 failed; ")
    whole = files(out)
    stamp = (out / "train/ball_1.npz").stat().st_mtime_ns
    (out / "test/box_2.npz").unlink()
    report = export_dataset(shapes.url, out, "dense", resolution=32)
    assert (report.written, report.kept) == (3, 1)  # box_2 again, and what the limit had left out
    assert (out / "train/ball_1.npz").stat().st_mtime_ns == stamp
    assert whole.items() <= files(out).items()


def test_points_of_a_stopped_run_are_made_whole(shapes: Store, tmp_path: Path) -> None:
    """The last file of a sample stands for the others: without it, all are written again."""
    out = tmp_path / "out"
    export_dataset(shapes.url, out, "points", points=50, splits=["train"])
    whole = files(out)
    (out / "deepsdf/SdfSamples/ocnf/ball/ball_1.npz").unlink()
    (out / "occupancy_networks/ball/ball_1/points.npz").write_bytes(b"half")
    report = export_dataset(shapes.url, out, "points", points=50, splits=["train"])
    assert (report.written, report.kept) == (1, 2)
    assert files(out) == whole


def listed(out: Path) -> dict[str, list[str]]:
    """The lists of Occupancy Networks by category and split, each equal to DeepSDF's."""
    found = {path.relative_to(out / "occupancy_networks").as_posix(): path.read_text().split()
             for path in sorted(out.rglob("*.lst"))}
    for path in (out / "deepsdf").glob("*.json"):
        there = json.loads(path.read_text())["ocnf"]
        assert there == {name.split("/")[0]: keys for name, keys in found.items()
                         if keys and name.endswith(f"/{path.stem}.lst")}
    return found


def test_the_lists_name_what_is_there(shapes: Store, tmp_path: Path) -> None:
    """Whatever limits and splits the runs had; a category without samples of a split has an empty list."""
    def export(**options: object) -> dict[str, list[str]]:
        export_dataset(shapes.url, tmp_path / "out", "points", points=50, **options)
        return listed(tmp_path / "out")

    train = {"ball/train.lst": ["ball_1", "ball_2"], "box/train.lst": ["box_1"]}
    assert export(splits=["train"], limit=1) == {"ball/train.lst": ["ball_1"]}
    assert export(splits=["test"]) == {"ball/train.lst": ["ball_1"], "ball/test.lst": [],
                                       "box/train.lst": [], "box/test.lst": ["box_2"]}
    whole = {**train, "ball/test.lst": [], "box/test.lst": ["box_2"]}
    assert export() == whole
    assert export(limit=1) == whole
    (tmp_path / "out/deepsdf/SdfSamples/ocnf/box/box_1.npz").unlink()
    assert export(splits=["test"]) == {**whole, "box/train.lst": []}


def test_the_lists_of_a_damaged_data_set(shapes: Store, tmp_path: Path) -> None:
    for name in ("shard-000001.tar", "shard-000001.json"):
        (shapes.root / "train" / name).unlink()
    for catalogue in (shapes.root / "train").glob("catalogue*"):
        catalogue.unlink()
    export_dataset(shapes.url, tmp_path / "out", "points", points=50)
    assert listed(tmp_path / "out") == {"ball/train.lst": ["ball_1"], "box/train.lst": ["box_1"],
                                        "ball/test.lst": [], "box/test.lst": ["box_2"]}


@pytest.mark.parametrize("format_", ["points", "mesh"])
def test_a_sample_that_was_interrupted_is_made_again(shapes: Store, tmp_path: Path, format_: str,
                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped after the first of a sample's files, by which the sample must not count as done."""
    options = {"points": 50} if format_ == "points" else {}
    export_dataset(shapes.url, tmp_path / "whole", format_, splits=["test"], **options)
    put, names = Store.put_bytes, []

    def stop(store: Store, name: str, data: bytes) -> None:
        names.append(name)
        if len(names) == 3:  # the record, the first file, and now the second
            raise KeyboardInterrupt
        put(store, name, data)

    out = tmp_path / "out"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Store, "put_bytes", stop)
        export_dataset(shapes.url, out, format_, splits=["test"], **options)
    report = export_dataset(shapes.url, out, format_, splits=["test"], **options)
    assert (report.written, report.kept) == (1, 0)
    assert files(out) == files(tmp_path / "whole")


def test_other_settings_or_another_data_set_are_refused(shapes: Store, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_dataset(shapes.url, out, "points", points=50, limit=1)
    before = files(out)
    for change, field in (({"points": 60}, "points"), ({"coordinates": "metres"}, "coordinates"),
                          ({"resolution": 32}, "resolution")):
        with pytest.raises(OcnfError) as caught:
            export_dataset(shapes.url, out, "points", limit=1, **{"points": 50, **change})
        assert (caught.value.code, caught.value.field) == ("misfit", field)
    assert files(out) == before
    (out / "export-points.json").write_text("[]")
    with pytest.raises(OcnfError, match="damaged"):
        export_dataset(shapes.url, out, "points", points=50, limit=1)
    assert export_dataset(shapes.url, out, "dense", resolution=32, limit=1).written == 2  # beside it


@pytest.mark.parametrize(("wrong", "field", "expected"), [
    ({"resolution": 128}, "resolution", "32, 64"), ({"variant": "v9"}, "variant", "v2"),
    ({"encoding": "occupancy"}, "encoding", "tsdf, histogram")])
def test_a_mistyped_setting_does_not_bind_the_folder(shapes: Store, tmp_path: Path, wrong: dict, field: str,
                                                     expected: str) -> None:
    """By the manifest before anything is written; without one, because no sample was."""
    right, out = {"resolution": 32, "variant": "v2", "encoding": "tsdf"}, tmp_path / "out"
    report = export_dataset(shapes.url, out, "dense", **{**right, **wrong})
    assert report.written == 0 and len(report.failures) == 4
    assert export_dataset(shapes.url, out, "dense", **right).written == 4
    manifest = Manifest.from_dict({
        "name": "known", "source": {"kind": "shapes", "categories": ["chair"], "counts": {"train": 4}},
        "resolutions": [32, 64],
        "inputs": [{"name": "v2", "views": 2, "sigma": 0.02, "encodings": ["tsdf", "histogram"]}]})
    write_dataset(shapes, load_dataset(shapes).model_copy(update={"manifest": manifest.to_dict()}))
    with pytest.raises(OcnfError) as caught:
        export_dataset(shapes.url, tmp_path / "new", "dense", **{**right, **wrong})
    assert (caught.value.field, caught.value.expected) == (field, expected)
    assert not (tmp_path / "new").exists()
    assert export_dataset(shapes.url, tmp_path / "new", "dense", **right).written == 4


def test_the_record_stays_where_a_sample_was_written(shapes: Store, tmp_path: Path) -> None:
    """Though this run made none: what lies there is of these settings."""
    export_dataset(shapes.url, tmp_path, "dense", resolution=64, splits=["test"])
    (shapes.root / "train/shard-000000.tar").unlink()
    report = export_dataset(shapes.url, tmp_path, "dense", resolution=64, splits=["train"])
    assert (report.written, report.kept) == (0, 0)
    with pytest.raises(OcnfError, match="other settings"):
        export_dataset(shapes.url, tmp_path, "dense", resolution=32)


def test_a_sample_that_fails_does_not_stop_the_others(shapes: Store, tmp_path: Path) -> None:
    """One has no such resolution, one is damaged, one shard is gone."""
    report = export_dataset(shapes.url, tmp_path / "a", "dense", resolution=64)
    assert report.written == 3
    assert [(key, error.code) for key, error in report.failures] == [("ball_2", "missing")]
    assert "expected 32" in str(report.failures[0][1])
    shard = shapes.root / "train/shard-000000.tar"
    damaged = bytearray(shard.read_bytes())
    damaged[damaged.index(b"box_1.target-32.oct") + 600] ^= 1
    shard.write_bytes(damaged)
    (shapes.root / "train/shard-000001.tar").unlink()
    (shapes.root / "train/shard-000001.json").unlink()
    report = export_dataset(shapes.url, tmp_path / "b", "dense", resolution=32)
    assert report.written == 2
    codes = {key: error.code for key, error in report.failures}
    assert codes == {"box_1": "checksum", "train/shard-000001.tar[0]": "missing"}


@pytest.mark.parametrize(("wrong", "field"), [({"splits": ["val"]}, "split"), ({"limit": 0}, "limit")])
def test_what_is_not_there_is_named(shapes: Store, tmp_path: Path, wrong: dict, field: str) -> None:
    with pytest.raises(OcnfError) as caught:
        export_dataset(shapes.url, tmp_path / "out", "dense", **wrong)
    assert caught.value.field == field
    assert not (tmp_path / "out").exists()


def test_several_processes_write_what_one_writes(shapes: Store, tmp_path: Path) -> None:
    reports = [export_dataset(shapes.url, tmp_path / str(jobs), "points", points=50, jobs=jobs)
               for jobs in (1, 2)]
    assert files(tmp_path / "1") == files(tmp_path / "2")
    assert [report.written for report in reports] == [4, 4]


@pytest.mark.parametrize("inside", ["", "/", "/train", "/exports/a"])
def test_the_data_set_s_own_folder_is_no_place_for_an_export(shapes: Store, inside: str) -> None:
    before = files(Path(shapes.url))
    with pytest.raises(OcnfError, match="would lie in the data set"):
        export_dataset(shapes.url, shapes.url + inside, "dense", limit=1)
    assert files(Path(shapes.url)) == before
