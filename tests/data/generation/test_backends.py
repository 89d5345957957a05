"""The same bytes wherever the work is done and wherever it goes; a worker that dies costs a new try."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import NamedTuple

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.generation import backends, generate
from ocnf_data.generation.plan import make_plan
from ocnf_data.generation.shard_task import make_shard
from ocnf_data.generation.worker import supervisor as supervisor_module
from ocnf_data.verify.verify import verify


class Made(NamedTuple):
    """What one process makes of some meshes, with the real maker."""

    root: Path
    files: dict[str, bytes]


@pytest.fixture(scope="module")
def serial(tmp_path_factory, write_meshes, define, contents) -> Made:
    root, out = tmp_path_factory.mktemp("meshes"), tmp_path_factory.mktemp("serial")
    write_meshes(root / "chair/train", "abcdefghi")
    assert generate(define(), out, root, progress=False).samples == 9
    assert verify(str(out)).ok
    return Made(root, contents(out))


@pytest.mark.parametrize("backend", [
    "loky",
    pytest.param("dask", marks=pytest.mark.filterwarnings("ignore::DeprecationWarning")),
    pytest.param("ray", marks=[pytest.mark.slow, pytest.mark.filterwarnings("ignore")]),
])
def test_every_backend_makes_the_same_bytes(serial, define, tmp_path, contents, backend) -> None:
    pytest.importorskip({"loky": "joblib", "dask": "distributed", "ray": "ray"}[backend])
    out = tmp_path / backend
    generate(define(), f"file://{out}", serial.root, 2, backend, progress=False)
    assert contents(out) == serial.files


def test_to_s3_with_two_workers(serial, define, s3_url) -> None:
    generate(define(), f"{s3_url}/set", serial.root, 2, progress=False)
    store = Store(f"{s3_url}/set")
    assert {name: store.read_bytes(name) for name in store.list() if "timings" not in name} == serial.files
    assert generate(define(), f"{s3_url}/set", serial.root, progress=False).made == 0


def test_to_memory_with_one_job(serial, define) -> None:
    generate(define(), "memory://set", serial.root, progress=False)
    store = Store("memory://set")
    assert {name: store.read_bytes(name) for name in store.list() if "timings" not in name} == serial.files


@pytest.mark.parametrize(("jobs", "backend"), [(2, "loky"), (1, "dask")])
def test_memory_is_refused_where_it_would_be_lost(define, meshes, jobs, backend) -> None:
    with pytest.raises(OcnfError, match="lives in one process"):
        generate(define(), "memory://other", meshes("a"), jobs, backend, progress=False)


@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_a_worker_that_dies_costs_a_new_try(define, meshes, tmp_path, contents, fake, backend) -> None:
    """The worker itself, not the child its items run in: what it was making is made again."""
    root = meshes([*(f"ok_{i}" for i in range(9)), "orphan-once_1"])
    out = tmp_path / "out"
    assert generate(define(), out, root, 2, backend, progress=False).samples == 10
    generate(define(), tmp_path / "again", root, progress=False)
    assert contents(out) == contents(tmp_path / "again")


def test_workers_that_keep_dying_end_the_run(define, meshes, tmp_path, fake) -> None:
    root = meshes([*(f"ok_{i}" for i in range(6)), "orphan_1"])
    with pytest.raises(OcnfError, match="worker processes keep dying"):
        generate(define(), tmp_path / "out", root, 2, progress=False)
    assert not (tmp_path / "out/dataset.json").exists()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("kind", ["folder", "list"])
def test_what_reaches_a_dask_worker_is_a_shard_and_not_the_plan(
        define, meshes, tmp_path, fake, monkeypatch, kind) -> None:
    """A cluster with its worker in this process: tasks come over TCP, and are looked at as they arrive."""
    distributed = pytest.importorskip("distributed")
    arrived = []

    def look(task):
        arrived.append(task)
        return make_shard(task)

    names = [f"ok_{i:03}" for i in range(200)]
    root = meshes(names)
    source = {"kind": "list", "items": {"train": [f"chair/train/{name}.off" for name in names]}}
    manifest = define(source=source) if kind == "list" else define()
    monkeypatch.setattr(backends, "make_shard", look)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, protocol="tcp://",
                                  dashboard_address=None, host="127.0.0.1") as cluster:
        monkeypatch.setenv("DASK_SCHEDULER_ADDRESS", cluster.scheduler_address)
        report = generate(manifest, tmp_path / "out", root, 1, "dask", progress=False)
    assert report.samples == 200
    plan = make_plan(manifest, root)
    assert sorted((task.shard for task in arrived), key=lambda shard: shard.number) == list(plan.shards)
    sizes = [len(pickle.dumps(task)) for task in arrived]
    assert len(sizes) == 50
    assert max(sizes) < 4000 < len(plan.to_json()) / 10


@pytest.mark.parametrize(("jobs", "backend", "field"), [(0, "loky", "jobs"), (1, "slurm", "backend")])
def test_bad_workers(define, meshes, tmp_path, fake, jobs, backend, field) -> None:
    with pytest.raises(OcnfError) as caught:
        generate(define(), tmp_path / "out", meshes(["ok_1"]), jobs, backend, progress=False)
    assert caught.value.field == field


def test_the_real_maker_is_where_it_is_said_to_be() -> None:
    module, _, name = supervisor_module.DEFAULT_MAKER.partition(":")
    assert Path(supervisor_module.__file__).parents[1].joinpath("sample.py").exists()
    assert (module, name) == ("ocnf_data.generation.sample", "maker")
