"""Promises 1 to 3: whole shards only, resumed runs equal uninterrupted ones, changes are refused."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_data.generation import fingerprint, generate
from ocnf_data.shards import load_dataset, write_dataset
from ocnf_data.shards.walk import index_from_tar

DRIVER = Path(__file__).with_name("driver.py")


def start(manifest: Path, out: Path, root: Path, jobs: int, *maker: str) -> subprocess.Popen[str]:
    """A run in a process group of its own."""
    command = [sys.executable, str(DRIVER), str(manifest), str(out), str(root), str(jobs), *maker]
    return subprocess.Popen(command, start_new_session=True, stdout=subprocess.PIPE, text=True)


def finish(run: subprocess.Popen[str]) -> str:
    output, _ = run.communicate(timeout=120)
    return output


def running(group: int) -> list[str]:
    """The processes of a process group that have not ended (Linux)."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it ended while we looked
            state, _, its_group = path.read_text().rpartition(") ")[2].split()[:3]
            if int(its_group) == group and state != "Z":
                found.append(path.parent.name)
    return found


@pytest.fixture
def job(meshes, define, tmp_path: Path) -> tuple[Path, Path]:
    """24 slow items in 6 shards, one of them refused, one crashing: (manifest, meshes)."""
    root = meshes([*(f"slow_{i:02}" for i in range(22)), "refuse_1", "segfault_1"])
    path = tmp_path / "tiny.yaml"
    path.write_text(json.dumps(define().to_dict()))  # JSON is YAML
    return path, root


@pytest.mark.parametrize("jobs", [1, 2])
def test_killed_at_random_moments_and_resumed(job, tmp_path, contents, fake, jobs) -> None:
    manifest, root = job
    uninterrupted = tmp_path / "uninterrupted"
    generate(manifest, uninterrupted, root, progress=False)
    out = tmp_path / "killed"
    chance = random.Random(jobs)
    # Not by the clock alone, which a busy machine stretches: each kill comes at a random moment after so many
    # shards, and then the run is left to finish.
    for n_shards in (0, 1, 2):
        run = start(manifest, out, root, jobs)
        while len(list(out.glob("train/shard-*.json"))) < n_shards:
            time.sleep(0.01)
        time.sleep(chance.uniform(0, 0.15) + 0.5 * (n_shards == 0))  # of which starting takes about half
        os.killpg(run.pid, signal.SIGKILL)
        finish(run)
        assert run.returncode == -signal.SIGKILL
        for tar in out.glob("train/shard-*.tar"):
            with tar.open("rb") as file:
                index = index_from_tar(file, "train", tar.name, tar)
            index_file = tar.with_suffix(".json")
            assert not index_file.exists() or index_file.read_bytes() == index.to_json()
    assert not (out / "dataset.json").exists()
    run = start(manifest, out, root, jobs)
    finish(run)
    assert run.returncode == 0
    files = contents(out)
    assert files == contents(uninterrupted)
    assert len([name for name in files if name.endswith(".tar")]) == 6


@pytest.fixture(scope="module")
def real(tmp_path_factory, write_meshes, define, contents) -> tuple[Path, Path, dict[str, bytes]]:
    """10 items in 5 shards, made by the real maker without interruption: (manifest, meshes, files)."""
    folder = tmp_path_factory.mktemp("real")
    write_meshes(folder / "meshes/chair/train", [f"m{i}" for i in range(10)])
    (folder / "real.yaml").write_text(json.dumps(define(shards={"samples": 2}).to_dict()))
    generate(folder / "real.yaml", folder / "out", folder / "meshes", progress=False)
    return folder / "real.yaml", folder / "meshes", contents(folder / "out")


def items_done(out: Path) -> int:
    """Of a run of shards of two items, those of the shard in the making included."""
    finished = {path.stem.removeprefix("shard-") for path in out.glob("train/shard-*.json")}
    live = 0
    for path in out.glob(".progress/train-*"):
        with contextlib.suppress(OSError):  # its shard was finished while we looked
            live += path.stat().st_size * (path.name.removeprefix("train-") not in finished)
    return 2 * len(finished) + live


@pytest.mark.parametrize("jobs", [1, 2])
def test_real_samples_are_the_same_after_kills(real, tmp_path, contents, jobs) -> None:
    """Killed after a random number of items, within a shard or between two, then resumed: the same bytes."""
    manifest, root, uninterrupted = real
    maker, out = "ocnf_data.generation.sample:maker", tmp_path / "killed"
    chance = random.Random(jobs)
    for n_items in sorted(chance.sample(range(1, 8), 2)):
        run = start(manifest, out, root, jobs, maker)
        while items_done(out) < n_items and run.poll() is None:
            time.sleep(0.002)
        os.killpg(run.pid, signal.SIGKILL)
        finish(run)
        assert run.returncode == -signal.SIGKILL
        assert not (out / "dataset.json").exists()
    run = start(manifest, out, root, jobs, maker)
    finish(run)
    assert run.returncode == 0
    assert contents(out) == uninterrupted


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_leaves_a_resumable_state_and_says_so(job, tmp_path, contents, fake, jobs) -> None:
    manifest, root = job
    out = tmp_path / "stopped"
    run = start(manifest, out, root, jobs)
    while not list(out.glob("train/shard-*.json")):
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGINT)  # as a terminal does: to everyone in the foreground
    assert "the same command resumes" in finish(run)
    assert run.returncode == 130
    assert not (out / "dataset.json").exists()
    report = generate(manifest, out, root, progress=False)
    assert 0 < report.made < 24
    generate(manifest, tmp_path / "uninterrupted", root, progress=False)
    assert contents(out) == contents(tmp_path / "uninterrupted")


def test_workers_end_with_their_driver(job, tmp_path, fake) -> None:
    """Only the driver is killed: a worker that went on could write into the folder of a later run."""
    manifest, root = job
    run = start(manifest, tmp_path / "killed", root, 2)
    while not list((tmp_path / "killed").glob("train/shard-*.json")):
        time.sleep(0.02)
    assert len(running(run.pid)) > 2
    run.kill()
    finish(run)
    deadline = time.monotonic() + 20
    while running(run.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert running(run.pid) == []


def test_more_jobs_than_shards(job, tmp_path, fake) -> None:
    manifest, root = job
    assert generate(manifest, tmp_path / "out", root, 10_000_000, progress=False).samples == 22


@pytest.mark.parametrize(("jobs", "backend"), [(1, "loky"), (2, "loky"), (2, "dask")])
def test_trouble_in_mid_shard_leaves_no_partial_shard(
        meshes, define, tmp_path, contents, fake, jobs, backend) -> None:
    """The disk is full for one item, while others are being made and more are waiting."""
    root = meshes([*(f"slow_{i}" for i in range(23)), "full-unfixed_1"])
    out = tmp_path / "out"
    with pytest.raises(OcnfError, match="disk is full") as caught:
        generate(define(), out, root, jobs, backend, progress=False)
    assert caught.value.code == "disk_full"
    assert not [path for path in out.rglob("*") if path.name.startswith((".tmp", ".lock", ".progress"))]
    assert len(list(out.glob("train/*.tar"))) == len(list(out.glob("train/shard-*.json"))) < 6
    assert not (out / "dataset.json").exists()
    (root / ".fixed").touch()
    generate(define(), out, root, progress=False)
    generate(define(), tmp_path / "uninterrupted", root, progress=False)
    assert contents(out) == contents(tmp_path / "uninterrupted")


def test_a_finished_data_set_is_left_as_it_is(meshes, define, tmp_path, contents, fake) -> None:
    root, out = meshes(["ok_1", "ok_2"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    before = contents(out)
    report = generate(define(), out, root, progress=False)
    assert (report.made, report.samples) == (0, 2)
    assert contents(out) == before


def test_stopped_before_any_write_and_resumed(meshes, define, tmp_path, contents, fake, monkeypatch) -> None:
    """Each file that the driver writes is the last one, in turn; `dataset.json` comes after all others."""
    root = meshes([*(f"ok_{i}" for i in range(5)), "refuse_1"])
    begun: list[str] = []
    written: list[str] = []
    writing = Store.writing

    @contextlib.contextmanager
    def counted(store, name):
        if len(begun) == stop:
            raise KeyboardInterrupt
        begun.append(name)
        with writing(store, name) as path:
            yield path
        written.append(name)

    monkeypatch.setattr(Store, "writing", counted)
    stop = -1
    generate(define(), tmp_path / "whole", root, progress=False)
    names = [name for name in written if not name.startswith("timings/")]
    assert names[0] == "plan.json"
    assert names[-3:] == ["failures.jsonl", "train/catalogue.safetensors", "dataset.json"]
    assert set(names[:-3]) >= {"train/shard-000001.json", "train/shard-000001.tar"}
    for n in range(len(written)):
        out = tmp_path / f"stopped-{n}"
        begun.clear()
        stop = n
        with pytest.raises(KeyboardInterrupt):
            generate(define(), out, root, progress=False)
        assert not (out / "dataset.json").exists()
        stop = -1
        generate(define(), out, root, progress=False)
        assert contents(out) == contents(tmp_path / "whole")


def test_a_data_set_of_an_earlier_version_gains_its_catalogue(
        meshes, define, tmp_path, contents, fake) -> None:
    root, out = meshes([f"ok_{i}" for i in range(6)]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    before, info = contents(out), load_dataset(str(out))
    (out / "train/catalogue.safetensors").unlink()
    files = tuple(entry for entry in info.files if "catalogue" not in entry.name)
    write_dataset(Store(out), info.model_copy(update={"files": files}))
    assert load_dataset(str(out)).checksum == info.identity
    assert generate(define(), out, root, progress=False).made == 0
    assert contents(out) == before


def test_a_lost_or_changed_catalogue_is_written_again(meshes, define, tmp_path, contents, fake) -> None:
    root, out = meshes([f"ok_{i}" for i in range(6)]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    before = contents(out)
    catalogue = out / "train/catalogue.safetensors"
    for damage in (catalogue.unlink, lambda: catalogue.write_bytes(b"x")):
        damage()
        assert generate(define(), out, root, progress=False).made == 0
        assert contents(out) == before


@pytest.mark.parametrize("what", ["tar", "json"])
def test_a_lost_or_damaged_file_is_made_again(meshes, define, tmp_path, contents, fake, what) -> None:
    root, out = meshes([f"ok_{i}" for i in range(8)]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    before = contents(out)
    victim = out / f"train/shard-000001.{what}"
    victim.write_bytes(victim.read_bytes()[:-512])
    assert generate(define(), out, root, progress=False).made == 4
    assert contents(out) == before


@pytest.mark.parametrize("damage", [
    lambda data: data.replace(b'"tiny"', b'"tinx"'), lambda data: data[:-100], lambda data: b"",
    lambda data: data.replace(b'"schema": 1', b'"schema": 3'), lambda data: b"\xff" + data])
def test_a_damaged_account_is_as_good_as_none(meshes, define, tmp_path, contents, fake, damage) -> None:
    root, out = meshes([*(f"ok_{i}" for i in range(6)), "refuse_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    before = contents(out)
    account = out / "dataset.json"
    account.write_bytes(damage(before["dataset.json"]))
    assert account.read_bytes() != before["dataset.json"]
    assert generate(define(), out, root, progress=False).made == 0
    assert contents(out) == before
    account.write_bytes(damage(before["dataset.json"]))
    tar = out / "train/shard-000001.tar"
    tar.write_bytes(bytes([tar.read_bytes()[0] ^ 1]) + tar.read_bytes()[1:])
    assert generate(define(), out, root, progress=False).made == 3
    assert contents(out) == before


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize("damage", [
    lambda row: row[:-9], lambda row: b"\xff" + row, lambda row: row.replace(b"{", b"["),
    lambda row: b"[" * 100_000, lambda row: b"7\n", lambda row: row.replace(b'"stage"', b'"state"'),
    lambda row: row.replace(b'"render"', b"7"), lambda row: row.replace(b"render", b"rendes")])
def test_damaged_rows_of_failures_are_as_good_as_none(
        meshes, define, tmp_path, contents, fake, damage, finished) -> None:
    """The shard is made again. A letter within a text is told by dataset.json alone."""
    root, out = meshes([*(f"ok_{i}" for i in range(6)), "refuse_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    before = contents(out)
    (rows,) = (out / "failures").iterdir()
    data = rows.read_bytes()
    rows.write_bytes(damage(data))
    assert rows.read_bytes() != data
    if not finished:
        if b"rendes" in rows.read_bytes():
            return
        (out / "dataset.json").unlink()
    assert generate(define(), out, root, progress=False).made in (3, 4)
    assert contents(out) == before


def test_a_shard_that_comes_out_different_is_refused(meshes, define, tmp_path, contents, fake) -> None:
    """`dataset.json` lists bytes; a repaired data set must have those, or be left without them."""
    root, out = meshes(["ok_1", "segfault-unfixed_1"]), tmp_path / "out"
    generate(define(limits={"failure_threshold": 1.0}), out, root, progress=False)
    (root / ".fixed").touch()
    (out / "train/shard-000000.json").unlink()
    before = contents(out)
    with pytest.raises(OcnfError, match="not the one that dataset"):
        generate(define(), out, root, progress=False)
    for name in ("dataset.json", "failures.jsonl", "train/catalogue.safetensors"):
        assert (out / name).read_bytes() == before[name]


@pytest.mark.parametrize(("changes", "field", "values"), [
    ({"seed": 1}, "seed", ("1", "0")),
    ({"inputs": [{"name": "v2", "views": 2, "sigma": 0.03, "encodings": ["tsdf"]}]}, "inputs[0].sigma",
     ("0.03", "0.02")),
    ({"resolutions": [64, 128]}, "resolutions[1]", ("128", "absent")),
    ({"shards": {"samples": 5}}, "shards.samples", ("5", "4")),
])
def test_a_changed_manifest_is_refused(meshes, define, tmp_path, fake, changes, field, values) -> None:
    root, out = meshes(["ok_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    with pytest.raises(OcnfError) as caught:
        generate(define(**changes), out, root, progress=False)
    assert (caught.value.code, caught.value.field) == ("changed", field)
    assert values[0] in caught.value.found
    assert values[1] in caught.value.expected


def test_when_to_give_up_may_change(meshes, define, tmp_path, fake) -> None:
    root, out = meshes(["ok_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    assert generate(define(limits={"timeout_s": 5.0}), out, root, progress=False).made == 0


def test_a_changed_mesh_is_refused(meshes, define, tmp_path, fake) -> None:
    root, out = meshes(["ok_1", "ok_2"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    victim = root / "chair/train/ok_2.off"
    text = victim.read_text()
    victim.write_text(text + "\n")
    with pytest.raises(OcnfError, match="a mesh of train has changed") as caught:
        generate(define(), out, root, progress=False)
    assert caught.value.field == "chair/train/ok_2.off"
    victim.unlink()
    with pytest.raises(OcnfError, match="a mesh of train is gone"):
        generate(define(), out, root, progress=False)
    victim.write_text(text)
    (root / "chair/train/ok_3.off").write_text(text)
    with pytest.raises(OcnfError, match="a mesh of train is new"):
        generate(define(), out, root, progress=False)


def test_another_schema_library_or_cpu(meshes, define, tmp_path, fake, monkeypatch) -> None:
    root, out = meshes(["ok_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    plan = json.loads((out / "plan.json").read_bytes())

    def refusal(**changes: object) -> OcnfError:
        (out / "plan.json").write_bytes(canonical_json({**plan, **changes}, indent=1))
        with pytest.raises(OcnfError) as caught:
            generate(define(), out, root, progress=False)
        assert caught.value.code == "changed"
        return caught.value

    assert refusal(schema=0).field == "schema"
    libraries = {**plan["fingerprint"]["libraries"], "numpy": "1.0"}
    error = refusal(fingerprint={**plan["fingerprint"], "libraries": libraries})
    assert (error.field, error.expected) == ("libraries.numpy", "1.0")
    (out / "plan.json").write_bytes(canonical_json(plan, indent=1))
    monkeypatch.setattr(fingerprint, "cpu_type", lambda: "abacus")
    report = generate(define(), out, root, progress=False)
    assert "abacus" in report.warnings[0]


@pytest.mark.parametrize("blob", [b"", b"[1]", b'{"schema": 1}', b'{"schema": 1, "shards": {"x": []}}'])
def test_a_plan_that_is_none(meshes, define, tmp_path, fake, blob) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "plan.json").write_bytes(blob)
    with pytest.raises(OcnfError, match=r"plan\.json"):
        generate(define(), out, meshes(["ok_1"]), progress=False)
    assert (out / "plan.json").read_bytes() == blob


def test_shards_without_a_plan_are_not_touched(meshes, define, tmp_path, fake) -> None:
    root, out = meshes(["ok_1"]), tmp_path / "out"
    generate(define(), out, root, progress=False)
    (out / "plan.json").unlink()
    with pytest.raises(OcnfError, match=r"no plan\.json"):
        generate(define(), out, root, progress=False)


def test_two_runs_at_once_are_refused(job, tmp_path, fake) -> None:
    manifest, root = job
    out = tmp_path / "out"
    run = start(manifest, out, root, 1)
    while not (out / "plan.json").exists():
        time.sleep(0.02)
    with pytest.raises(OcnfError, match="another run is writing here"):
        generate(manifest, out, root, progress=False)
    os.killpg(run.pid, signal.SIGKILL)
    finish(run)


def test_a_lock_whose_file_is_gone_keeps_nobody_out(meshes, define, tmp_path, fake, monkeypatch) -> None:
    """Another run ends, and removes the file, between our opening it and locking it."""
    out = tmp_path / "out"
    lock = fcntl.flock

    def late(file, how) -> None:
        (out / ".lock").unlink()
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(OcnfError, match="another run"):
        generate(define(), out, meshes(["ok_1"]), progress=False)


def test_other_splits_of_shapes_are_called_that(define, tmp_path) -> None:
    source = {"kind": "shapes", "categories": ["ball"], "counts": {"train": 1, "val": 1}}
    manifest = define(source=source)
    generate(manifest, tmp_path, splits=["train"], progress=False)
    for splits in (["train", "val"], ["val"]):
        with pytest.raises(OcnfError, match=r"splits: the folder was begun with other splits; found .*val, "
                                            "expected train"):
            generate(manifest, tmp_path, splits=splits, progress=False)
