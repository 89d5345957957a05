"""Whole files or none, in every kind of place, and every failure named."""

from __future__ import annotations

import errno
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import TEMPORARY_PREFIX, storage_errors


@pytest.fixture(params=["path", "file://", "memory://", "s3://"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    """An empty store of each kind."""
    if request.param == "path":
        return Store(tmp_path / "set")
    if request.param == "file://":
        return Store(f"file://{tmp_path}/set")
    if request.param == "memory://":
        return Store(f"memory://{uuid.uuid4().hex}/set")
    return Store(request.getfixturevalue("s3_url") + "/set")


def test_what_is_written_is_read_back(store: Store) -> None:
    data = bytes(range(256)) * 5
    assert not store.exists("train/a.tar")
    assert store.list() == []
    store.put_bytes("train/a.tar", data)
    store.put_bytes("train/b.json", b"{}")
    store.put_bytes("dataset.json", b"")
    assert store.list() == ["dataset.json", "train/a.tar", "train/b.json"]
    assert store.list("train") == ["train/a.tar", "train/b.json"]
    assert store.list("val") == []
    assert store.exists("train/a.tar") and not store.exists("train")
    assert store.size("train/a.tar") == len(data)
    assert store.read_bytes("train/a.tar") == data
    assert store.read_range("train/a.tar", 250, 10) == data[250:260]
    assert store.read_range("train/a.tar", 0, 0) == b""
    with store.open("train/a.tar") as file:
        file.seek(512)
        assert file.read(3) == data[512:515]


def test_a_new_file_replaces_the_old_and_removal_is_idempotent(store: Store) -> None:
    for data in (b"first", b"second"):
        store.put_bytes("x", data)
        assert store.read_bytes("x") == data
    store.remove("x")
    store.remove("x")
    assert not store.exists("x")


def test_a_range_past_the_end_is_truncation(store: Store) -> None:
    store.put_bytes("x", b"12345")
    for offset, size in ((0, 6), (5, 1), (9, 2)):
        with pytest.raises(OcnfError, match="ends too early") as caught:
            store.read_range("x", offset, size)
        assert caught.value.code == "truncated"
        assert caught.value.where == store.where("x")


@pytest.mark.parametrize("read", [
    lambda s: s.read_bytes("no/thing"), lambda s: s.size("no/thing"),
    lambda s: s.read_range("no/thing", 0, 1), lambda s: s.open("no/thing").read(),
], ids=["read_bytes", "size", "read_range", "open"])
def test_a_missing_file_is_named(store: Store, read: Callable[[Store], object]) -> None:
    with pytest.raises(OcnfError, match="no such file") as caught:
        read(store)
    assert caught.value.code == "missing"
    assert str(caught.value.where).endswith("no/thing")


def test_an_exception_while_writing_leaves_nothing(store: Store, tmp_path: Path) -> None:
    store.put_bytes("train/x", b"old")
    with pytest.raises(RuntimeError), store.writing("train/x") as path:
        path.write_bytes(b"half of the new")
        raise RuntimeError
    assert store.read_bytes("train/x") == b"old"
    with pytest.raises(RuntimeError), store.writing("train/y") as path:
        path.write_bytes(b"half")
        raise RuntimeError
    assert store.list() == ["train/x"]
    assert not list(tmp_path.rglob(f"{TEMPORARY_PREFIX}*"))


_WRITE_AND_HANG = """
import sys, time
from ocnf_data.files.storage import Store
with Store(sys.argv[1]).writing("train/x") as path:
    path.write_bytes(b"half")
    print("writing", flush=True)
    time.sleep(60)
"""


def test_a_killed_writer_leaves_a_temporary_only(tmp_path: Path) -> None:
    store = Store(tmp_path)
    command = [sys.executable, "-c", _WRITE_AND_HANG, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stdout.readline() == b"writing\n"
        child.send_signal(signal.SIGKILL)
    assert not store.exists("train/x")
    assert store.list() == []
    left = store.clean_temporaries()
    assert len(left) == 1 and left[0].startswith(f"train/{TEMPORARY_PREFIX}")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_data_and_folder_reach_the_disk_before_and_after_the_rename(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[str] = []
    real_fsync, real_replace = os.fsync, Path.replace

    def fsync(handle: int) -> None:
        events.append("folder" if Path(f"/proc/self/fd/{handle}").resolve().is_dir() else "file")
        real_fsync(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", lambda a, b: (events.append("rename"), real_replace(a, b))[1])
    Store(tmp_path).put_bytes("x", b"data")
    assert events == ["file", "rename", "folder"]


def test_files_are_as_readable_as_the_umask_allows(tmp_path: Path) -> None:
    Store(tmp_path).put_bytes("x", b"data")
    umask = os.umask(0)
    os.umask(umask)
    assert (tmp_path / "x").stat().st_mode & 0o777 == 0o666 & ~umask


@pytest.mark.parametrize(("number", "code"), [
    (errno.ENOSPC, "disk_full"), (errno.EDQUOT, "disk_full"), (errno.EACCES, "permission"),
    (errno.EROFS, "permission"), (errno.ENOENT, "missing"), (errno.EIO, "io"),
    (errno.ECONNREFUSED, "unreachable"), (errno.ETIMEDOUT, "unreachable"),
])
def test_failures_of_the_system_become_sentences(tmp_path: Path, number: int, code: str) -> None:
    store = Store(tmp_path)
    with pytest.raises(OcnfError) as caught, store.writing("train/x"):
        raise OSError(number, os.strerror(number))
    assert caught.value.code == code
    assert str(tmp_path / "train/x") in str(caught.value)
    assert not list((tmp_path / "train").iterdir())


def test_a_real_full_disk() -> None:
    full = Path("/dev/full")
    with pytest.raises(OcnfError) as caught, storage_errors(full), full.open("wb") as file:
        file.write(b"x" * 100_000)
    assert caught.value.code == "disk_full"
    assert "/dev/full" in str(caught.value)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_real_lack_of_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OcnfError) as caught:
        Store(tmp_path).put_bytes("x", b"")
    tmp_path.chmod(0o700)
    assert caught.value.code == "permission"


def test_a_file_in_the_place_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_bytes(b"")
    with pytest.raises(OcnfError, match="out: a file is in the place of a folder"):
        Store(tmp_path / "out").put_bytes("x", b"")


def test_a_bug_in_the_block_is_not_blamed_on_the_storage(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), storage_errors(tmp_path):
        _ = 1 / 0


def test_a_dead_endpoint_is_unreachable_not_missing(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import s3fs

    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(OcnfError) as caught:
        Store(s3_url).exists("x")
    s3fs.S3FileSystem.clear_instance_cache()
    assert caught.value.code == "unreachable"
    assert s3_url in str(caught.value)


def test_a_missing_bucket_is_named(s3_url: str) -> None:
    with pytest.raises(OcnfError) as caught:
        Store(s3_url + "-other").put_bytes("x", b"data")
    assert caught.value.code == "missing"
    assert s3_url + "-other" in str(caught.value)


def test_one_put_a_file(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """s3fs by itself splits from 100 MB on, which leaves parts behind when it is killed."""
    import s3fs

    calls: list[str] = []
    real = s3fs.S3FileSystem._call_s3

    async def count(self: object, method: str, *args: object, **kwargs: object) -> object:
        calls.append(method)
        return await real(self, method, *args, **kwargs)

    monkeypatch.setattr(s3fs.S3FileSystem, "_call_s3", count)
    with Store(s3_url).writing("x") as path:
        path.write_bytes(b"")
        os.truncate(path, 110 * 2**20)
    assert calls == ["put_object"]


def _write(store: Store) -> None:
    store.put_bytes("from/worker", b"worker")


def test_a_worker_process_writes_to_s3(s3_url: str) -> None:
    store = Store(s3_url)
    store.put_bytes("from/driver", b"driver")
    assert store.list("from") == store.list() == ["from/driver"]  # fills whatever cache of listings there is
    assert not store.exists("from/worker")
    worker = multiprocessing.get_context("spawn").Process(target=_write, args=(store,))
    worker.start()
    worker.join(60)
    assert worker.exitcode == 0
    assert store.exists("from/worker") and store.size("from/worker") == 6
    assert store.list("from") == store.list() == ["from/driver", "from/worker"]
    assert store.read_bytes("from/worker") == b"worker"


def test_a_store_pickles_as_its_url(store: Store) -> None:
    store.put_bytes("x", b"1")
    again = pickle.loads(pickle.dumps(store))
    assert again.url == store.url and again.read_bytes("x") == b"1"
    assert again.shared_between_processes == (store.protocol != "memory")


@pytest.mark.parametrize("url", [
    "pipe:cat /etc/passwd", "pipe://ls", "PIPE:ls", "nonsense://x/y", "simplecache::s3://bucket/x", "exec:ls",
    "", "a\0b",
])
def test_unknown_and_command_protocols_are_refused(url: str) -> None:
    with pytest.raises(OcnfError):
        Store(url)


def test_a_local_path_with_a_colon_needs_a_slash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OcnfError, match=r"Write \./"):
        Store("set:1")
    Store("./set:1").put_bytes("x", b"1")
    assert (tmp_path / "set:1" / "x").read_bytes() == b"1"


@pytest.mark.parametrize("name", ["", "/x", "../x", "a/../x", "a//x", "./x", "a/", "a\\x", "a\0"])
def test_names_stay_inside_the_store(tmp_path: Path, name: str) -> None:
    store = Store(tmp_path)
    for use in (store.exists, store.read_bytes, store.where, lambda n: store.put_bytes(n, b"")):
        with pytest.raises(OcnfError, match="not a name inside"):
            use(name)


@settings(max_examples=30, deadline=None)
@given(data=st.binary(max_size=300),
       cuts=st.lists(st.tuples(st.integers(0, 300), st.integers(0, 300)), max_size=5))
def test_ranges_are_slices(data: bytes, cuts: list[tuple[int, int]]) -> None:
    store = Store(f"memory://{uuid.uuid4().hex}")
    store.put_bytes("x", data)
    for offset, size in cuts:
        if offset + size <= len(data):
            assert store.read_range("x", offset, size) == data[offset:offset + size]
        elif size:
            with pytest.raises(OcnfError, match="ends too early"):
                store.read_range("x", offset, size)
