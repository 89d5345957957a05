"""Odd paths among the meshes: rings of links, names that are no text, links out of the folder, huge files."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from ocnf_data.generation import generate
from ocnf_data.generation.plan import make_plan
from ocnf_data.generation.remake import remake
from ocnf_data.shards import load_dataset
from ocnf_data.shards.browse import stored_samples
from ocnf_data.verify.verify import verify

FOLDER = {"kind": "folder", "shares": {"train": 1.0}}


def rows(out: Path) -> dict[str, tuple[str, str]]:
    """(stage, code) of each row of failures.jsonl, by source, read as a strict parser of JSON does."""
    text = (out / "failures.jsonl").read_bytes().decode("ascii")
    assert "\\ud" not in text, "a lone surrogate is not JSON that others can read"
    return {row["source"]: (row["stage"], row["code"]) for row in map(json.loads, text.splitlines())}


@pytest.mark.parametrize("kind", ["modelnet", "folder"])
def test_a_ring_of_links_and_a_name_that_is_no_text_cost_a_row_each(meshes, define, tmp_path, kind) -> None:
    root, out = meshes(["a"]), tmp_path / "out"
    folder = root / "chair/train"
    (folder / "b.off").symlink_to("c.off")
    (folder / "c.off").symlink_to("b.off")
    (folder / os.fsdecode(b"caf\xe9.off")).write_bytes((folder / "a.off").read_bytes())
    (folder / os.fsdecode(b"caf\xe8.off")).write_bytes((folder / "a.off").read_bytes())
    manifest = define(source=FOLDER) if kind == "folder" else define()
    report = generate(manifest, out, root, progress=False)
    assert (report.items, report.samples) == (5, 1)
    assert rows(out) == {f"chair/train/{name}.off": ("read", "unreadable")
                         for name in ("b", "c", r"caf\xe9", r"caf\xe8")}
    assert verify(out).ok
    assert load_dataset(str(out)).counts.failures == 4
    assert generate(manifest, out, root, progress=False).made == 0, "its own plan.json is the same plan"


def test_a_folder_whose_name_is_no_text(meshes, define, tmp_path) -> None:
    root, out = meshes(["a"]), tmp_path / "out"
    (root / os.fsdecode(b"t\xfcr")).mkdir()
    (root / os.fsdecode(b"t\xfcr/b.off")).write_bytes((root / "chair/train/a.off").read_bytes())
    assert generate(define(source=FOLDER), out, root, progress=False).samples == 1
    assert rows(out) == {r"t\xfcr/b.off": ("read", "unreadable")}
    assert json.loads((out / "failures.jsonl").read_text())["category"] == r"t\xfcr"


def test_a_list_with_names_that_no_file_can_have(meshes, define, tmp_path) -> None:
    root, out = meshes(["a"]), tmp_path / "out"
    paths = ["chair/train/a.off", "nul\0.off", "x" * 300 + ".off"]
    manifest = define(source={"kind": "list", "items": {"train": paths}})
    assert generate(manifest, out, root, progress=False).samples == 1
    assert set(rows(out).values()) == {("read", "unreadable")}
    assert len(rows(out)) == 2


def test_a_file_over_the_limit_is_planned_without_being_read(meshes, define, monkeypatch) -> None:
    root = meshes(["a", "b"])
    huge = root / "chair/train/huge.stl"
    with huge.open("wb") as file:
        file.truncate(2**40)  # sparse
    opened = []
    real = Path.open
    monkeypatch.setattr(Path, "open", lambda self, *args, **more: opened.append(self.name)
                        or real(self, *args, **more))
    limit = (root / "chair/train/a.off").stat().st_size
    with (root / "chair/train/b.off").open("a") as file:
        file.write("\n")
    opened.clear()
    plan = make_plan(define(limits={"max_bytes": limit}), root)
    assert {item.source.rpartition("/")[2]: item.sha256 is None for item in plan.items} == {
        "a.off": False, "b.off": True, "huge.stl": True}
    assert opened.count("a.off") == 1 and not {"huge.stl", "b.off"} & set(opened)


def test_a_file_over_the_limit_costs_a_row(meshes, define, tmp_path) -> None:
    root, out = meshes(["a"]), tmp_path / "out"
    with (root / "chair/train/huge.stl").open("wb") as file:
        file.truncate(2**40)
    assert generate(define(), out, root, progress=False).samples == 1
    assert rows(out) == {"chair/train/huge.stl": ("read", "too_large")}


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_planning_is_interrupted_at_once(meshes, define, tmp_path, kind) -> None:
    """Two files of a terabyte that the limit allows: the signal comes when 50 MB of them were read."""
    root = meshes(["a"])
    for name in ("huge", "large"):
        with (root / f"chair/train/{name}.stl").open("wb") as file:
            file.truncate(2**40)
    manifest = tmp_path / "tiny.yaml"
    manifest.write_text(json.dumps(define(limits={"max_bytes": 2**41}).to_dict()))
    command = [sys.executable, "-m", "ocnf_data", "generate", str(manifest), "--out", str(tmp_path / "out"),
               "--meshes", str(root), "--jobs", "1"]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        progress = Path(f"/proc/{run.pid}/io")
        while int(progress.read_text().split()[1]) < 50e6:  # rchar: bytes read so far
            assert run.poll() is None
            time.sleep(0.01)
        run.send_signal(kind)
        begin = time.monotonic()
        run.wait(timeout=30)
        assert time.monotonic() - begin < 5, "a second on a machine of its own"
        assert run.returncode != 0
    finally:
        with contextlib.suppress(ProcessLookupError):
            run.kill()
        run.communicate()


@pytest.mark.parametrize("kind", ["modelnet", "folder"])
def test_hidden_files_are_counted(meshes, define, tmp_path, kind) -> None:
    """Promise 5: what is left out is an exclusion with its reason."""
    root, out = meshes(["a", "b", ".hidden"]), tmp_path / "out"
    for name in ("..off", "._a.off", ".off", ".hidden.txt"):  # the last two have no mesh's suffix
        (root / "chair/train" / name).write_text("")
    manifest = define(source=FOLDER) if kind == "folder" else define()
    report = generate(manifest, out, root, progress=False)
    assert (report.items, report.samples, len(report.exclusions)) == (5, 2, 3)
    assert rows(out) == {f"chair/train/{name}": ("plan", "excluded") for name in
                         ("..off", "._a.off", ".hidden.off")}
    assert "begins with a dot" in report.exclusions[0].message
    assert verify(out).ok


def test_a_link_out_of_the_folder_is_followed_and_its_content_not_quoted(meshes, define, tmp_path) -> None:
    root, out = meshes(["a", "b"]), tmp_path / "out"
    (root / "chair/train/b.off").rename(tmp_path / "elsewhere.off")
    (root / "chair/train/b.off").symlink_to(tmp_path / "elsewhere.off")
    (tmp_path / "passwords").write_text("root:x:0:0:correct horse battery staple\n")
    (root / "chair/train/c.off").symlink_to(tmp_path / "passwords")
    assert generate(define(), out, root, progress=False).samples == 2
    assert rows(out) == {"chair/train/c.off": ("read", "unreadable")}
    assert not any(word in (out / "failures.jsonl").read_text() for word in ("root:", "horse", "staple"))


def test_square_brackets_are_no_markup(meshes, define, tmp_path, capsys) -> None:
    root, out = meshes(["a"]), tmp_path / "c[/d]" / "o[red]1"
    manifest = define(source=FOLDER, views="keep")
    report = generate(manifest, out, root, progress=False)
    console = Console(file=io.StringIO(), width=400)
    console.print(report.table())
    assert "c[/d]/o[red]1" in console.file.getvalue()
    other = define(source=FOLDER, normalise={"extent": 2.0})
    again = generate(other, tmp_path / "again", root, views=out / "views")
    assert again.samples == 1 and "c[/d]/o[red]1" in "".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("name", ["shapes:chair:train:0/t 1", "shapes:chair:train:1", "scenes:rooms:1"])
def test_files_called_like_procedural_items_are_read_as_files(name, meshes, define, tmp_path) -> None:
    root, out = meshes(["a"]), tmp_path / "out"
    path = root / f"{name}.off"
    path.parent.mkdir(exist_ok=True)
    (root / "chair/train/a.off").rename(path)
    manifest = define(source=FOLDER)
    assert generate(manifest, out, root, progress=False).samples == 1
    sample, = stored_samples(str(out))
    again = remake(manifest, sample.facts, root)
    assert again.mesh.sha256 == sample.facts["mesh"]["sha256"]
