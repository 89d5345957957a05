"""Promise 1: a shard under its final name is whole."""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.shards import ShardEntry, ShardIndex, ShardReader, ShardWriter, find_complete

Members = dict[str, bytes]
Make = Callable[[str, dict[str, int]], Members]


def files_in(root: Path) -> dict[str, str]:
    """SHA-256 of every file in a folder by name, hidden ones included."""
    return {path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(root.rglob("*")) if path.is_file()}


def write(store: Store, opaque: Make, sizes: tuple[int, ...] = (10, 600)) -> ShardWriter:
    with ShardWriter(store, "train", 0) as writer:
        for i, size in enumerate(sizes):
            writer.add(f"chair_{i}", opaque(f"chair_{i}", {"target-64.oct": size}), {"render": 0.5})
    return writer


def test_a_tar_that_everybody_reads(tmp_path: Path, opaque: Make) -> None:
    write(Store(tmp_path), opaque)
    with tarfile.open(tmp_path / "train/shard-000000.tar") as tar:
        read = {info.name: tar.extractfile(info).read() for info in tar}
    assert read == {f"chair_{i}.{name}": payload for i, size in enumerate((10, 600))
                    for name, payload in opaque(f"chair_{i}", {"target-64.oct": size}).items()}
    listing = subprocess.run(["tar", "tvf", tmp_path / "train/shard-000000.tar"], capture_output=True,
                             text=True, check=True)
    assert len(listing.stdout.splitlines()) == 4
    assert not listing.stderr


def test_the_index_says_where_each_payload_lies(tmp_path: Path, opaque: Make) -> None:
    writer = write(Store(tmp_path), opaque)
    blob = (tmp_path / "train/shard-000000.tar").read_bytes()
    raw = json.loads((tmp_path / "train/shard-000000.json").read_bytes())
    assert raw["sha256"] == hashlib.sha256(blob).hexdigest() == writer.entry.sha256
    assert raw["size"] == len(blob) == writer.entry.size
    assert "timings" not in raw
    for sample in raw["samples"]:
        payloads = opaque(sample["key"], {"target-64.oct": 600 if sample["key"] == "chair_1" else 10})
        assert [member["name"] for member in sample["members"]] == list(payloads)
        for member in sample["members"]:
            assert blob[member["offset"]:][:member["size"]] == payloads[member["name"]]
            assert member["sha256"] == hashlib.sha256(payloads[member["name"]]).hexdigest()
    timings = json.loads((tmp_path / "timings/train-000000.json").read_bytes())
    assert timings == {"chair_0": {"render": 0.5}, "chair_1": {"render": 0.5}}


@pytest.mark.parametrize("failure", [ValueError("bug"), KeyboardInterrupt(), SystemExit(3), OcnfError("bad")])
def test_an_exception_in_the_block_publishes_nothing(tmp_path: Path, opaque: Make,
                                                     failure: BaseException) -> None:
    with pytest.raises(type(failure)), ShardWriter(Store(tmp_path), "train", 0) as writer:
        writer.add("chair_0", opaque("chair_0", {"target-64.oct": 5000}))
        raise failure
    assert files_in(tmp_path) == {}


def test_an_exception_leaves_an_earlier_shard_as_it_was(tmp_path: Path, opaque: Make) -> None:
    store = Store(tmp_path)
    write(store, opaque)
    before = files_in(tmp_path)
    with pytest.raises(ValueError, match="a bug"), ShardWriter(store, "train", 0):
        raise ValueError("a bug")
    assert files_in(tmp_path) == before
    assert find_complete(store, "train", 0, check_sha256=True)


def test_rewriting_never_pairs_a_new_tar_with_an_old_index(tmp_path: Path, opaque: Make,
                                                           monkeypatch: pytest.MonkeyPatch) -> None:
    """Same size, other bytes, and the index cannot be written: the shard must not count as done."""
    store = Store(tmp_path)
    write(store, opaque)
    put = Store.put_bytes

    def no_index(self: Store, name: str, data: bytes) -> None:
        if name.startswith("train/"):
            raise OcnfError("the disk is full", code="disk_full")
        put(self, name, data)

    monkeypatch.setattr(Store, "put_bytes", no_index)
    changed = opaque("chair_1", {"target-64.oct": 600})
    changed["target-64.oct"] = changed["target-64.oct"][::-1]
    with pytest.raises(OcnfError, match="full"), ShardWriter(store, "train", 0) as writer:
        writer.add("chair_0", opaque("chair_0", {"target-64.oct": 10}))
        writer.add("chair_1", changed)
    assert not find_complete(store, "train", 0)


@pytest.mark.parametrize("members", [
    {}, {"target-64.oct": b"x"}, {"target-64.oct": b"x", "json": b"{}"}, {"json": b"{}"}, {"json": b"[1"},
    {"json": b"\xff"}, {"json": b"[" * 100_000}, {"json": b"{}", "depth.pyd": b"x"}])
def test_a_sample_that_the_format_does_not_allow_is_refused_whole(tmp_path: Path, opaque: Make,
                                                                  members: Members) -> None:
    with ShardWriter(Store(tmp_path), "train", 0) as writer:
        writer.add("chair_0", opaque("chair_0", {"target-64.oct": 10}))
        with pytest.raises(OcnfError):
            writer.add("chair_1", members)
        writer.add("chair_2", opaque("chair_2", {"target-64.oct": 10}))
    with ShardReader(Store(tmp_path), "train", writer.entry) as reader:
        assert [sample.key for sample, _ in reader.samples()] == ["chair_0", "chair_2"]


def test_keys_and_facts_are_checked(tmp_path: Path, opaque: Make, sample_json: Callable[..., bytes]) -> None:
    with ShardWriter(Store(tmp_path), "train", 0) as writer:
        writer.add("chair_0", opaque("chair_0", {"target-64.oct": 10}))
        for key in ("chair_0", "chair.v2", "../x", "", "a" * 65, "pipe:ls"):
            with pytest.raises(OcnfError):
                writer.add(key, opaque(key, {"target-64.oct": 10}))
        with pytest.raises(OcnfError, match="another sample"):
            writer.add("chair_1", opaque("chair_9", {"target-64.oct": 10}))
        for counts in ({}, {"target-64.oct": 0}, {"target-64.oct": -1}, {"target-64.oct": 2**40},
                       {"target-64.oct": 9, "target-128.oct": 9}):
            with pytest.raises(OcnfError):
                writer.add("chair_1", {"json": sample_json("chair_1", counts), "target-64.oct": b"x"})
        with pytest.raises(OcnfError, match="different names"):  # webdataset reads names in lower case
            writer.add("chair_1", opaque("chair_1", {"V4-tsdf-64.oct": 3, "v4-tsdf-64.oct": 3}))
    for split in ("../train", "Train", "", "a/b", "timings", "views", "quarantine"):
        with pytest.raises(OcnfError):
            ShardWriter(Store(tmp_path), split, 0)
    with pytest.raises(OcnfError):
        ShardWriter(Store(tmp_path), "train", 1_000_000)


def test_done_means_that_index_and_tar_match(tmp_path: Path, opaque: Make) -> None:
    store = Store(tmp_path)
    assert find_complete(store, "train", 0) is None
    entry = write(store, opaque).entry
    tar, index = tmp_path / "train/shard-000000.tar", tmp_path / "train/shard-000000.json"
    for found in (find_complete(store, "train", 0), find_complete(store, "train", 0, check_sha256=True)):
        assert found is not None
        assert ShardEntry.of(found) == entry
    whole, described = tar.read_bytes(), index.read_bytes()
    tar.write_bytes(whole[:-512])
    assert not find_complete(store, "train", 0)
    tar.write_bytes(whole[:600] + b"\1" + whole[601:])
    assert not find_complete(store, "train", 0, check_sha256=True)
    tar.unlink()
    assert not find_complete(store, "train", 0)
    tar.write_bytes(whole)
    for wrong in (b"", b"{}", described[:-1], described.replace(b'"train"', b'"test"'),
                  described.replace(b"shard-000000", b"shard-000001"), described + b"\n"):
        index.write_bytes(wrong)
        assert not find_complete(store, "train", 0)
    index.unlink()
    assert not find_complete(store, "train", 0)


WRITE = """
import sys
from ocnf_data.shards import ShardWriter
from ocnf_data.files.storage import Store
import json, random
print("ready", flush=True)
for number in range(40):
    with ShardWriter(Store(sys.argv[1]), "train", number) as writer:
        for i in range(4):
            key = f"chair_{number}_{i}"
            facts = {"key": key, "category": "chair", "source": "x", "leaf_counts": {"target-64.oct": 1}}
            payload = random.Random(key).randbytes(100_000)
            writer.add(key, {"json": json.dumps(facts).encode(), "target-64.oct": payload})
"""


def test_the_same_bytes_in_another_process(tmp_path: Path) -> None:
    for name, seed in (("a", "1"), ("b", "2")):
        subprocess.run([sys.executable, "-c", WRITE.replace("40", "2"), tmp_path / name], check=True,
                       stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONHASHSEED": seed})
    assert files_in(tmp_path / "a") == files_in(tmp_path / "b")
    assert len(files_in(tmp_path / "a")) == 4


def test_a_killed_writer_leaves_whole_shards_only(tmp_path: Path) -> None:
    """SIGKILL at random moments: what has its final name is whole, and a rerun ends with the same bytes."""
    subprocess.run([sys.executable, "-c", WRITE, tmp_path / "whole"], check=True, stdout=subprocess.DEVNULL)
    delays = random.Random(0)
    store = Store(tmp_path / "killed")
    seen = 0
    for _ in range(6):
        process = subprocess.Popen([sys.executable, "-c", WRITE, store.url], stdout=subprocess.PIPE)
        process.stdout.readline()
        time.sleep(delays.uniform(0, 0.25))
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        for name in store.list("train"):
            if name.endswith(".json"):
                index = ShardIndex.from_json(store.read_bytes(name), name)
                assert find_complete(store, "train", int(index.shard[6:12]), check_sha256=True)
                seen += 1
            else:  # a tar without its index is whole too
                reference = (tmp_path / "whole" / name).read_bytes()
                assert store.read_bytes(name) == reference
    assert seen > 0
    subprocess.run([sys.executable, "-c", WRITE, store.url], check=True, stdout=subprocess.DEVNULL)
    store.clean_temporaries()
    assert files_in(tmp_path / "killed") == files_in(tmp_path / "whole")
