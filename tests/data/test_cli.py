"""`ocnf-data` as a user meets it: commands, exit statuses, sentences."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest

from ocnf_data.cli import main
from ocnf_data.errors import OcnfError
from ocnf_data.generation import generate
from ocnf_data.manifest import Manifest

MANIFEST = {
    "name": "tiny",
    "source": {"kind": "shapes", "categories": ["chair", "mug"], "counts": {"train": 5, "test": 1}},
    "camera": {"rig": "icosphere0", "width": 48, "height": 40, "fx": 28, "fy": 28, "cx": 24, "cy": 20},
    "resolutions": [64],
    "inputs": [{"name": "v2", "views": 2, "sigma": 0.02, "encodings": ["tsdf"]}],
    "shards": {"samples": 2},
}
TRIANGLE = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 2 1\n"


class Result(NamedTuple):
    """What a command came to."""

    status: int
    out: str
    err: str


def ocnf(*arguments: object) -> Result:
    """Run `ocnf-data` in this process, which has numba loaded, with a terminal that wraps no sentence."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", ["ocnf-data", *map(str, arguments)])
        patch.setenv("COLUMNS", "200")
        with pytest.raises(SystemExit) as ended:
            main()
    return Result(ended.value.code or 0, out.getvalue(), err.getvalue())  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(manifest, data set), made by the command."""
    folder = tmp_path_factory.mktemp("cli")
    manifest = folder / "tiny.yaml"
    manifest.write_text(json.dumps(MANIFEST))
    result = ocnf("generate", manifest, "--out", folder / "set", "--jobs", 2)
    assert result.status == 0, result.err
    assert "items a minute" in result.out
    return manifest, folder / "set"


def test_help_names_every_command() -> None:
    """As a process of its own: this is how it is called, and it must not need what only commands need."""
    command = [sys.executable, "-m", "ocnf_data", "--help"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    for name in ("generate", "verify", "info", "repair", "export", "doctor", "watertight"):
        assert name in result.stdout
    assert "--retry-failed" in ocnf("generate", "--help").out


def test_the_version_is_told() -> None:
    from ocnf_data import __version__

    assert ocnf("--version").out == f"ocnf {__version__}\n"


def test_generating_again_resumes(made) -> None:
    manifest, out = made
    before = (out / "dataset.json").stat().st_size
    result = ocnf("generate", manifest, "--out", out, "--jobs", 1)
    assert result.status == 0
    assert (out / "dataset.json").stat().st_size == before
    assert re.search(r"made in this run\D* 0 ", result.out)


def test_verify_info_and_repair(made) -> None:
    _, out = made
    assert ocnf("verify", out, "--jobs", 1).status == 0
    text = ocnf("info", out).out
    assert "6 inputs = 6 samples" in text
    assert "v2-tsdf-64.oct" in text
    shard = out / "train/shard-000001.tar"
    whole = shard.read_bytes()
    damaged = bytearray(whole)
    damaged[5000] ^= 1
    shard.write_bytes(damaged)
    result = ocnf("verify", out, "--jobs", 1)
    assert result.status == 1
    assert "train/shard-000001.tar" in result.out
    result = ocnf("repair", out, "--jobs", 1)
    assert result.status == 0, result.err
    assert shard.read_bytes() == whole
    assert (out / "quarantine/train/shard-000001.tar").read_bytes() == damaged
    (out / "train/shard-000000.json").unlink()
    assert "index was written again" in ocnf("repair", out, "--jobs", 1).out
    assert ocnf("verify", out, "--jobs", 1).status == 0
    assert "no shard is damaged" in ocnf("repair", out, "--jobs", 1).out


@pytest.mark.parametrize(("change", "words"), [
    ({"sed": 1}, ("tiny.yaml", "sed")),
    ({"resolutions": [100]}, ("resolutions[0]", "100", "multiple of 8")),
    ({"source": {"kind": "modelnet", "categories": ["chair"], "counts": {"train": 1}}}, ("--meshes ROOT",)),
])
def test_a_users_error_is_a_sentence(tmp_path, change, words) -> None:
    manifest = tmp_path / "tiny.yaml"
    manifest.write_text(json.dumps({**MANIFEST, **change}))
    result = ocnf("generate", manifest, "--out", tmp_path / "set")
    assert result.status == 1
    assert "Traceback" not in result.err
    assert result.err.startswith("error:")
    for word in words:
        assert word in result.err
    with pytest.raises(OcnfError):
        ocnf("--debug", "generate", manifest, "--out", tmp_path / "set")


def test_a_changed_manifest_is_refused(made, tmp_path) -> None:
    _, out = made
    manifest = tmp_path / "tiny.yaml"
    manifest.write_text(json.dumps({**MANIFEST, "seed": 7}))
    result = ocnf("generate", manifest, "--out", out)
    assert result.status == 1
    assert "seed" in result.err
    assert "found 7, expected 0" in result.err


def test_too_many_failures_are_an_exit_status(tmp_path) -> None:
    meshes = tmp_path / "meshes/chair/train"
    meshes.mkdir(parents=True)
    (meshes / "a.off").write_text("OFF\n")
    manifest = tmp_path / "tiny.yaml"
    source = {"kind": "modelnet", "categories": ["chair"], "counts": {"train": "all"}}
    manifest.write_text(json.dumps({**MANIFEST, "source": source}))
    result = ocnf("generate", manifest, "--out", tmp_path / "set", "--meshes", tmp_path / "meshes")
    assert result.status == 1
    assert "100.0% of the items failed" in result.err
    assert len((tmp_path / "set/failures.jsonl").read_text().splitlines()) == 1


def test_watertight(tmp_path) -> None:
    """A tetrahedron without one of its faces."""
    source, out = tmp_path / "open.off", tmp_path / "closed.ply"
    source.write_text("OFF\n4 3 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n")
    result = ocnf("watertight", source, out, "--resolution", 64, "--jobs", 1)
    assert result.status == 0, result.err
    assert out.stat().st_size > 1000
    for name in ("nothing.off", "nothing", "shapes:airplane:1.off"):  # the last is not to become an emoji
        result = ocnf("watertight", tmp_path / name, out)
        assert (result.status, result.err) == (1, f"error: {tmp_path / name}: no such file or folder\n")
    source.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 2 1\n")  # a sheet: the command keeps it, too
    assert ocnf("watertight", source, out, "--resolution", 64, "--jobs", 1).status == 0
    source.write_text("garbage")
    result = ocnf("watertight", source, out, "--jobs", 1)
    assert result.status == 1
    assert result.err.count(str(source)) == 1


def test_repair_sets_nothing_aside_that_it_cannot_make_again(tmp_path) -> None:
    meshes, out = tmp_path / "meshes/chair/train", tmp_path / "set"
    meshes.mkdir(parents=True)
    (meshes / "a.off").write_text(TRIANGLE)
    manifest = tmp_path / "tiny.yaml"
    source = {"kind": "modelnet", "categories": ["chair"], "counts": {"train": "all"}}
    manifest.write_text(json.dumps({**MANIFEST, "source": source}))
    command = ("generate", manifest, "--out", out, "--meshes", tmp_path / "meshes", "--jobs", 1)
    assert ocnf(*command).status == 0
    shard = out / "train/shard-000000.tar"
    whole = shard.read_bytes()
    shard.write_bytes(whole[:-1])
    result = ocnf("repair", out, "--jobs", 1)
    assert result.status == 1
    assert "--meshes ROOT" in result.err
    assert shard.read_bytes() == whole[:-1]
    assert ocnf("repair", out, "--jobs", 1, "--meshes", tmp_path / "meshes").status == 0
    assert shard.read_bytes() == whole


def test_a_set_of_some_splits_is_repaired_as_it_was_made(tmp_path) -> None:
    """As `ocnf-model train` makes its validation set: the other splits are none of its business."""
    out = tmp_path / "set"
    generate(Manifest.from_dict(MANIFEST), out, splits=["test"], progress=False)
    shard = out / "test/shard-000000.tar"
    whole = shard.read_bytes()
    shard.write_bytes(whole[:-512])
    result = ocnf("repair", out, "--jobs", 1)
    assert result.status == 0, result.err
    assert shard.read_bytes() == whole and not (out / "train").exists()
    assert ocnf("verify", out, "--jobs", 1).status == 0


@pytest.fixture
def copied(made, tmp_path) -> Path:
    """A finished data set to be damaged."""
    out = tmp_path / "set"
    shutil.copytree(made[1], out, ignore=shutil.ignore_patterns("quarantine"))
    return out


def no_plan(out: Path) -> str:
    (out / "plan.json").unlink()
    return "plan.json"


def strange_shard(out: Path) -> str:
    shutil.copy(out / "train/shard-000000.tar", out / "train/shard-000099.tar")
    return "train/shard-000099.tar"


@pytest.mark.parametrize("damage", [no_plan, strange_shard])
def test_repair_names_what_it_cannot_mend(damage, copied) -> None:
    name = damage(copied)
    assert ocnf("verify", copied, "--jobs", 1).status == 1
    result = ocnf("repair", copied, "--jobs", 1)
    assert result.status == 1
    assert f"cannot be repaired: {name}: " in result.err
    assert "no shard is damaged" in result.out


@pytest.fixture(scope="module")
def refusing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `set`, of two good meshes and one that fails, in two shards; and `meshes`."""
    folder = tmp_path_factory.mktemp("refusing")
    (folder / "meshes/chair/train").mkdir(parents=True)
    for name, text in (("a", TRIANGLE), ("b", TRIANGLE.replace("1 0 0", "2 0 0")), ("bad", "OFF\n")):
        (folder / f"meshes/chair/train/{name}.off").write_text(text)
    source = {"kind": "modelnet", "categories": ["chair"], "counts": {"train": "all"}}
    report = generate(Manifest.from_dict({**MANIFEST, "source": source}), folder / "set", folder / "meshes",
                      progress=False)
    assert (report.samples, len(report.failures)) == (2, 1)
    return folder


def whole_files(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in sorted(out.rglob("*"))
            if path.is_file() and path.relative_to(out).parts[0] not in ("quarantine", "timings")}


def flipped(path: Path, at: bytes) -> None:
    data = path.read_bytes()
    path.write_bytes(data.replace(at, at[:-1] + bytes([at[-1] ^ 1]), 1))


@pytest.mark.parametrize("damage", [
    lambda path: flipped(path, b'"tiny'), lambda path: path.write_bytes(path.read_bytes()[:-200]),
    lambda path: path.write_bytes(b"")])
def test_a_damaged_dataset_json_is_made_again_by_either_command(refusing, tmp_path, damage) -> None:
    """By `repair` without the meshes: the plan, the indices and the rows of failures say it all."""
    out = tmp_path / "set"
    shutil.copytree(refusing / "set", out)
    whole = whole_files(out)
    damage(out / "dataset.json")
    broken = (out / "dataset.json").read_bytes()
    result = ocnf("verify", out, "--jobs", 1)
    assert result.status == 1 and "repair" in result.out
    result = ocnf("repair", out, "--jobs", 1)
    assert result.status == 0, result.err
    assert (out / "quarantine/dataset.json").read_bytes() == broken
    assert whole_files(out) == whole
    damage(out / "dataset.json")
    manifest = tmp_path / "tiny.yaml"
    manifest.write_text(json.dumps(json.loads(whole["plan.json"])["manifest"]))
    result = ocnf("generate", manifest, "--out", out, "--meshes", refusing / "meshes", "--jobs", 1)
    assert "dataset.json is damaged" in result.err
    assert whole_files(out) == whole


def test_shards_and_dataset_json_damaged_together(refusing, tmp_path) -> None:
    """What the tars must be is lost with it: each is held against its index, and made again if it differs."""
    out = tmp_path / "set"
    shutil.copytree(refusing / "set", out)
    whole = whole_files(out)
    flipped(out / "dataset.json", b'"tiny')
    shard = out / "train/shard-000001.tar"
    shard.write_bytes(whole["train/shard-000001.tar"][:-1] + b"x")
    before = whole_files(out)
    result = ocnf("repair", out, "--jobs", 1)
    assert result.status == 1 and "--meshes ROOT" in result.err
    assert whole_files(out) == before and not (out / "quarantine").exists()
    assert ocnf("repair", out, "--jobs", 1, "--meshes", refusing / "meshes").status == 0
    assert whole_files(out) == whole
    assert (out / "quarantine/train/shard-000001.tar").read_bytes()[-1:] == b"x"


@pytest.mark.parametrize("what", ["rows", "all rows", "pipe"])
def test_damaged_rows_of_failures_are_made_again(refusing, tmp_path, what) -> None:
    out = tmp_path / "set"
    shutil.copytree(refusing / "set", out)
    whole = whole_files(out)
    (rows,) = (out / "failures").iterdir()
    path = rows if what == "rows" else out / "failures.jsonl"
    if what == "pipe":
        path.unlink()
        os.mkfifo(path)
    else:
        flipped(path, b'"chai')
    assert ocnf("verify", out, "--jobs", 1).status == 1
    result = ocnf("repair", out, "--jobs", 1, *(("--meshes", refusing / "meshes") if what == "rows" else ()))
    assert result.status == 0, result.err
    assert whole_files(out) == whole
    assert f"set aside as quarantine/{path.relative_to(out)}" in result.out


def test_what_stands_in_a_shards_place_is_set_aside(copied) -> None:
    """A folder with something in it, a pipe, a link to nowhere; and again, so that the name is taken."""
    shard = copied / "train/shard-000001.tar"
    whole = shard.read_bytes()
    for number, put in enumerate((lambda: (shard.mkdir(), (shard / "mine").write_text("mine")),
                                  lambda: os.mkfifo(shard), lambda: shard.symlink_to("nowhere"))):
        shard.unlink()
        put()
        result = ocnf("repair", copied, "--jobs", 1)
        assert result.status == 0, result.err
        assert shard.read_bytes() == whole
        aside = copied / "quarantine/train" / f"shard-000001.tar{f'.{number}' if number else ''}"
        assert aside.is_symlink() or aside.exists()
    assert (copied / "quarantine/train/shard-000001.tar/mine").read_text() == "mine"
    assert ocnf("verify", copied, "--jobs", 1).status == 0


@pytest.mark.parametrize("with_index", [True, False])
def test_a_shard_of_a_terabyte_is_not_read(copied, with_index) -> None:
    shard = copied / "train/shard-000001.tar"
    whole = shard.read_bytes()
    with shard.open("r+b") as file:
        file.truncate(2**40)  # sparse
    if not with_index:
        shard.with_suffix(".json").unlink()
    result = ocnf("verify", copied, "--jobs", 1)
    assert result.status == 1 and "train/shard-000001.tar" in result.out
    assert ocnf("repair", copied, "--jobs", 1).status == 0
    assert shard.read_bytes() == whole


def test_a_plan_of_a_terabyte_is_not_read(made, copied) -> None:
    with (copied / "plan.json").open("r+b") as file:
        file.truncate(2**40)  # sparse
    assert "plan.json" in ocnf("verify", copied, "--jobs", 1).out
    assert "plan.json" in ocnf("repair", copied, "--jobs", 1).err
    (copied / "dataset.json").unlink()
    result = ocnf("generate", made[0], "--out", copied, "--jobs", 1)
    assert result.status == 1 and "plan.json" in result.err and "too large" in result.err

def test_export(made, tmp_path) -> None:
    """The account, what a second run keeps, and a setting that does not fit."""
    _, out = made
    target = tmp_path / "volumes"
    arguments = ("export", out, "--format", "dense", "--out", target, "--jobs", 1, "--split", "train",
                 "--limit", 2)
    result = ocnf(*arguments)
    assert result.status == 0, result.err
    assert result.out.startswith("2 samples = 2 written + 0 kept + 0 failed; ")
    assert len(list((target / "train").glob("*.npz"))) == 2
    assert "= 0 written + 2 kept + 0 failed" in ocnf(*arguments).out
    result = ocnf(*arguments, "--resolution", 64)
    assert result.status == 1
    assert "holds an export of other settings; found 64, expected nothing" in result.err
    result = ocnf(*arguments[:4], "--out", tmp_path / "none", "--jobs", 1, "--variant", "v9")
    assert result.status == 1
    assert "variant: the data set has no such variant; found v9, expected v2" in result.err
    assert not (tmp_path / "none").exists()
    result = ocnf(*arguments[:3], "obj", "--out", target)
    assert result.status == 2 and "dense" in result.err
