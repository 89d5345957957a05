"""Whatever is wrong with the data set or the place, a sentence says so, and what can be shown is shown."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ocnf_data.cli import app
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.generation import generate
from ocnf_data.manifest import Manifest
from ocnf_data.report.contents import Card, Scale
from ocnf_data.report.page import Page, PageWriter
from ocnf_data.report.run import write_report
from ocnf_data.shards.dataset import Counts, load_dataset, write_dataset

runner = CliRunner()


@pytest.fixture
def copied(report_made: Any, tmp_path: Path) -> Path:
    """A copy of the data set, to be damaged."""
    return Path(shutil.copytree(report_made.data, tmp_path / "OUT"))


def tars(data: Path) -> list[Path]:
    return sorted(data.glob("*/*.tar"))


def test_a_damaged_sample_is_named_and_the_others_are_shown(report_made: Any, copied: Path, tmp_path: Path,
                                                            read_page: Callable) -> None:
    first = tars(copied)[0]
    index = json.loads(first.with_suffix(".json").read_text())
    sample = index["samples"][0]
    member = next(one for one in sample["members"] if one["name"] == "target-32.oct")
    damaged = bytearray(first.read_bytes())
    damaged[member["offset"] + 600] ^= 1
    first.write_bytes(damaged)
    done = runner.invoke(app, ["report", str(copied), "--out", str(tmp_path / "page.html"), "--jobs", "1",
                               "--meshes", str(report_made.meshes)])
    assert done.exit_code == 1 and str(tmp_path / "page.html") in done.output
    page, sample_of = read_page(tmp_path / "page.html")
    assert len(page["samples"]) == 2 and sample["key"] not in {row["key"] for row in page["samples"]}
    assert any("1 sample could not be shown" in note for note in page["notes"])
    rows = page["failures"]["rows"]
    assert rows[0][0] == sample["key"] and rows[0][2] in ("checksum", "header", "padding") and len(rows) == 2
    assert all(sample_of(number)[1]["shown"] for number in range(2))


def test_a_damaged_index_takes_its_shard_alone(copied: Path, tmp_path: Path, read_page: Callable) -> None:
    lost = tars(copied)[0].with_suffix(".json")
    n = len(json.loads(lost.read_text())["samples"])
    lost.write_text("{}")
    done = write_report(str(copied), tmp_path / "page.html")
    page, _ = read_page(tmp_path / "page.html")
    assert len(done.failures) == n and len(page["samples"]) == 3 - n == done.n_samples > 0
    assert all(tars(copied)[0].name in key for key, _ in done.failures)
    assert any("no statistics" in note and lost.name in note for note in page["notes"])


def test_a_data_set_of_failures_alone_has_a_page(tmp_path: Path, read_page: Callable) -> None:
    (tmp_path / "meshes" / "mug").mkdir(parents=True)
    (tmp_path / "meshes" / "mug" / "broken.off").write_text("OFF\n3 1 0\n0 0 0\n")
    manifest = Manifest.from_dict({
        "name": "own", "source": {"kind": "folder", "shares": {"train": 1.0}}, "resolutions": [16],
        "limits": {"failure_threshold": 1.0}, "inputs": [
            {"name": "v3", "views": 3, "sigma": 0.02, "encodings": ["tsdf"]}]})
    assert generate(manifest, tmp_path / "OUT", tmp_path / "meshes", progress=False).samples == 0
    done = runner.invoke(app, ["report", str(tmp_path / "OUT"), "--out", str(tmp_path / "page.html")])
    assert done.exit_code == 0, done.output
    page, _ = read_page(tmp_path / "page.html")
    assert page["samples"] == [] and page["notes"] == ["This data set has no samples."]
    [row] = page["failures"]["rows"]
    assert "broken" in row[0] and row[2] == "unreadable"


def test_an_empty_data_set_has_a_page(copied: Path, tmp_path: Path, read_page: Callable) -> None:
    info = load_dataset(str(copied))
    (copied / "failures.jsonl").unlink()
    write_dataset(Store(copied), info.model_copy(update={
        "splits": {}, "files": (), "counts": Counts(items=0, samples=0, failures=0, exclusions=0)}))
    done = write_report(str(copied), tmp_path / "page.html")
    page, _ = read_page(tmp_path / "page.html")
    assert done.n_samples == 0 and page["notes"] == ["This data set has no samples."]
    assert page["failures"]["rows"] == []


@pytest.mark.parametrize(("options", "says"), [
    (["--split", "nope"], "no such split"), (["--variant", "nope"], "no such input"),
    (["--resolution", "64"], "no such resolution"), (["--up", "x"], "y or z"),
    (["--meshes", "/nowhere/at/all"], "no such folder"), (["--out", "page.txt"], "not the name of a page"),
])
def test_what_is_not_there_is_said_before_anything_is_drawn(report_made: Any, tmp_path: Path,
                                                            options: list[str], says: str) -> None:
    out = [] if "--out" in options else ["--out", str(tmp_path / "page.html")]
    done = runner.invoke(app, ["report", str(report_made.data), *out, *options])
    assert isinstance(done.exception, OcnfError) and says in str(done.exception)
    assert list(tmp_path.iterdir()) == []


def test_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match=r"dataset\.json"):
        write_report(str(tmp_path), tmp_path / "page.html")


def test_a_place_that_cannot_be_written(report_made: Any, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OcnfError, match="file"):
        write_report(str(report_made.data), tmp_path / "file" / "page.html", progress=pytest.fail)
    (tmp_path / "page.html").mkdir()
    with pytest.raises(OcnfError, match="a folder has that name"):
        write_report(str(report_made.data), tmp_path / "page.html", progress=pytest.fail)
    if os.geteuid():
        (tmp_path / "closed").mkdir(mode=0o500)
        with pytest.raises(OcnfError, match="closed"):
            write_report(str(report_made.data), tmp_path / "closed" / "page.html", progress=pytest.fail)


def test_a_mesh_that_has_changed_is_a_failure_and_without_meshes_the_truth_stands_in(
        report_made: Any, tmp_path: Path, read_page: Callable) -> None:
    meshes = Path(shutil.copytree(report_made.meshes, tmp_path / "meshes"))
    (meshes / "chair" / "a.ply").write_bytes((meshes / "mug" / "b.ply").read_bytes())
    done = write_report(str(report_made.data), tmp_path / "page.html", meshes=meshes)
    [(key, error)] = done.failures
    assert key == "chair-a" and error.code == "changed" and done.n_samples == 2
    assert not write_report(str(report_made.data), tmp_path / "page.html").failures
    page, sample = read_page(tmp_path / "page.html")
    for number in range(len(page["samples"])):
        names = [one["name"] for one in sample(number)[1]["shown"]]
        assert names == ["Noisy input", "VolFus", "Ground truth"]
        assert "in place of the mesh" in sample(number)[1]["shown"][0]["caption"]


def test_other_inputs_and_resolutions(report_made: Any, tmp_path: Path, read_page: Callable) -> None:
    write_report(str(report_made.data), tmp_path / "page.html", variant="occ", resolution=16, limit=1,
                 meshes=report_made.meshes)
    page, sample = read_page(tmp_path / "page.html")
    _, meta = sample(0)
    names = [one["name"] for one in meta["shown"]]
    assert names == ["Mesh", "Noisy input", "Input occupancy", "Ground truth"]
    assert meta["slices"][0]["width"] == 16 and len(page["samples"]) == 1
    assert page["notes"] == ["This page shows 1 of the 3 samples."]


# ---- one file, or a folder beside it


def card(key: str) -> Card:
    return Card(key, "train", "mug", f"mug/{key}.off", [1.0], b"picture", "blob" * 25_000)


def page(**changes: Any) -> Page:
    return replace(Page("title", "subtitle", Scale(3.0, 0.1, 0.3, 9), []), **changes)


def test_geometry_goes_beside_a_page_that_grows_too_large(tmp_path: Path) -> None:
    path = tmp_path / "a page.html"
    small = PageWriter(path)
    for number in range(5):
        small.add(card(f"key{number}"))
    assert small.finish(page()) == [path]
    whole = path.read_text()
    assert whole.count('<script type="text/plain" id="geometry-') == 5

    large = PageWriter(path, largest=len(whole) - 200_000)
    for number in range(5):
        large.add(card(f"key{number}"))
    assert large.finish(page()) == [path, tmp_path / "a page_files"]
    names = sorted(file.name for file in (tmp_path / "a page_files").iterdir())
    assert names == [f"{number:06d}.js" for number in range(5)]
    assert (tmp_path / "a page_files/000003.js").read_text() == f'ocnfReceive(3,"key3","{"blob" * 25_000}")\n'
    assert 'id="geometry-' not in path.read_text() and '"folder":"a page_files"' in path.read_text()

    (tmp_path / "a page_files/notes.txt").touch()  # somebody's own
    fewer = PageWriter(path, largest=1)
    fewer.add(card("key0"))
    fewer.finish(page())
    assert sorted(file.name for file in (tmp_path / "a page_files").iterdir()) == ["000000.js", "notes.txt"]
    small.finish(page())
    assert [file.name for file in (tmp_path / "a page_files").iterdir()] == ["notes.txt"]


def test_no_text_ends_a_script_or_becomes_markup(tmp_path: Path, read_page: Callable) -> None:
    evil = "</script><script>alert(1)</script><!-- & <img src=x>"
    writer = PageWriter(tmp_path / "page.html")
    writer.add(card("key")._replace(source=evil))
    writer.finish(page(title=evil, notes=[evil], provenance=[(evil, evil)]))
    text = (tmp_path / "page.html").read_text()
    assert "alert(1)</script>" not in text and "<img src=x>" not in text
    found, _ = read_page(tmp_path / "page.html")
    assert found["title"] == found["notes"][0] == found["samples"][0]["source"] == evil
    assert "three.js authors" in text and "Permission is hereby granted" in text  # the licence comes along


def test_a_full_disk_leaves_the_older_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = PageWriter(tmp_path / "page.html")
    writer.finish(page())
    before = (tmp_path / "page.html").read_text()

    def fail(*_: object) -> None:
        raise OcnfError("no space left", code="disk_full")

    monkeypatch.setattr(Store, "put_bytes", fail)
    with pytest.raises(OcnfError, match="no space left"):
        writer.finish(page(title="other"))
    assert (tmp_path / "page.html").read_text() == before
