"""`verify`, `info` and `repair` on sets that are whole, unfinished, and wrong in their accounts."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.shards import (
    Counts,
    DatasetInfo,
    FileEntry,
    ShardWriter,
    find_complete,
    load_dataset,
    write_dataset,
)
from ocnf_data.verify.problems import print_verify
from ocnf_data.verify.repair import find_damaged, quarantine, restore_index
from ocnf_data.verify.summary import describe, print_summary
from ocnf_data.verify.verify import verify

Members = dict[str, bytes]
TAR, INDEX = "train/shard-000000.tar", "train/shard-000000.json"


def shown(show: Callable[[Console], object], width: int = 200) -> str:
    text = io.StringIO()
    show(Console(file=text, width=width))
    return text.getvalue()


def rewrite(store: Store, failures: bytes | None = None, plan: bytes | None = None) -> None:
    """Another dataset.json, listing other failures or another plan: wrong books, right bytes."""
    info = load_dataset(store)
    files = {"failures.jsonl": failures, "plan.json": plan}
    for name, data in files.items():
        if data is not None:
            store.put_bytes(name, data)
    entries = tuple(FileEntry.of(name, store.read_bytes(name)) for name in files if store.exists(name))
    write_dataset(store, info.model_copy(update={"files": entries}))


def plan_of(*keys: str, exclusions: int = 0) -> bytes:
    shards = {"train": [[{"key": key} for key in keys]]}
    return json.dumps({"shards": shards, "exclusions": [{}] * exclusions}).encode()


ROW = b'{"code":"empty","item":"chair_bad","message":"no faces","stage":"read"}\n'
SAMPLES = [f"chair_000{i}" for i in range(4)]


def test_several_processes_find_what_one_finds(octree_set: Store) -> None:
    path = octree_set.root / TAR
    blob = bytearray(path.read_bytes())
    blob[600] ^= 1
    blob[-1] = 1
    path.write_bytes(blob)
    calls: list[tuple[int, int]] = []
    alone = verify(octree_set)
    shared = verify(octree_set, jobs=2, progress=lambda done, total: calls.append((done, total)))
    assert shared == alone
    assert len(alone.problems) == 3
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_an_unfinished_set_is_named_so_and_still_verified(octree_set: Store) -> None:
    octree_set.remove("dataset.json")
    report = verify(octree_set)
    assert [(p.file, p.code) for p in report.problems] == [("dataset.json", "missing")]
    assert (report.shards, report.samples, report.info) == (3, 4, None)
    octree_set.remove(INDEX)  # the writer was killed between tar and index
    (octree_set.root / "test/shard-000000.tar").write_bytes(b"x" * 100)
    codes = {(p.file, p.code) for p in verify(octree_set).problems}
    assert codes == {("dataset.json", "missing"), (TAR, "missing_index"),
                     ("test/shard-000000.tar", "truncated"), ("test/shard-000000.tar", "sha256")}


def test_missing_and_extra_files(octree_set: Store) -> None:
    octree_set.put_bytes("train/shard-000007.tar", bytes(1024))
    octree_set.put_bytes("train/notes.txt", b"x")
    octree_set.put_bytes("other/shard-000000.tar", bytes(1024))
    octree_set.put_bytes("README", b"hello")
    octree_set.put_bytes("views/chair.h5", b"x")
    octree_set.remove("failures.jsonl")
    octree_set.remove("test/shard-000000.json")
    report = verify(octree_set)
    assert {(p.file, p.code) for p in report.problems} == {
        ("train/shard-000007.tar", "extra"), ("train/notes.txt", "extra"),
        ("other/shard-000000.tar", "extra"), ("failures.jsonl", "missing"), ("failures.jsonl", "count"),
        ("test/shard-000000.tar", "missing_index")}
    assert report.notes == ["README is no part of the data set"]
    assert report.damaged_shards == ["test/shard-000000.tar"]


def test_an_empty_folder_and_a_missing_one(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        assert [p.code for p in verify(str(folder)).problems] == ["missing"]
        with pytest.raises(OcnfError, match="no data set here"):
            describe(str(folder))


def test_every_input_is_accounted_for_by_name(octree_set: Store) -> None:
    rewrite(octree_set, plan=plan_of(*SAMPLES, "chair_bad"))
    assert verify(octree_set).ok
    wrong: dict[str, tuple[dict[str, object], set[tuple[str, str | None]]]] = {
        "lost": ({"plan": plan_of(*SAMPLES, "chair_bad", "chair_lost")},
                 {("failures.jsonl", "chair_lost"), ("plan.json", None)}),
        "never planned": ({"plan": plan_of(*SAMPLES[1:], "chair_bad", "x")},
                          {("plan.json", "chair_0000"), ("failures.jsonl", "x")}),
        "both": ({"failures": ROW.replace(b"bad", b"0001"), "plan": plan_of(*SAMPLES, "chair_bad")},
                 {("failures.jsonl", "chair_0001"), ("failures.jsonl", "chair_bad")}),
        "twice": ({"failures": ROW + ROW, "plan": plan_of(*SAMPLES, "chair_bad")},
                  {("failures.jsonl", None), ("failures.jsonl", "chair_bad")}),
        "no row": ({"failures": b"[1]\n"}, {("failures.jsonl", None), ("failures.jsonl", "chair_bad")}),
        "no plan": ({"failures": ROW, "plan": b'{"shards": [[1]]}'}, {("plan.json", None)}),
        "exclusion": ({"plan": plan_of(*SAMPLES, "chair_bad", exclusions=1)}, {("plan.json", None)}),
    }
    for what, (change, expected) in wrong.items():
        rewrite(octree_set, **change)
        assert {(p.file, p.key) for p in verify(octree_set).problems} == expected, what


def test_rows_of_a_shard_that_the_whole_does_not_have(octree_set: Store) -> None:
    octree_set.put_bytes("failures/train-000000.jsonl", ROW)
    assert verify(octree_set).ok
    octree_set.put_bytes("failures/train-000000.jsonl", ROW.replace(b"no faces", b"no focus"))
    assert [p.file for p in verify(octree_set).problems] == ["failures/train-000000.jsonl"]


def test_counts_that_do_not_add_up_are_no_data_set(octree_set: Store) -> None:
    for counts in ((6, 4, 1, 0), (5, 5, 0, 0), (4, 4, 1, 0)):
        with pytest.raises(OcnfError, match=r"counts|accounted"):
            info = load_dataset(octree_set)
            total, samples, failures, exclusions = counts
            bad = Counts(items=total, samples=samples, failures=failures, exclusions=exclusions)
            DatasetInfo.from_json(info.model_copy(update={"counts": bad}).to_json(), "dataset.json")


def test_a_key_used_in_two_shards(write_set: Callable[..., Store],
                                  octree_samples: list[tuple[str, Members]]) -> None:
    store = write_set({"train": [octree_samples[:1]], "test": [octree_samples[:1]]})
    assert [(p.code, p.key) for p in verify(store).problems] == [("duplicate", "chair_0000")]


def test_a_set_in_memory(octree_samples: list[tuple[str, Members]], write_set: Callable[..., Store]) -> None:
    """Any fsspec file system: written, verified (in this process, whatever `jobs`), damaged, set aside."""
    store = write_set({"train": [octree_samples[:2], octree_samples[2:]]}, root="memory://shards/set")
    assert verify(store, jobs=2).ok
    blob = bytearray(store.read_bytes(TAR))
    blob[700] ^= 4
    store.put_bytes(TAR, bytes(blob))
    assert [shard.path for shard in find_damaged(store)] == [TAR]
    assert quarantine(store, TAR) == [f"quarantine/{INDEX}", f"quarantine/{TAR}"]
    assert store.read_bytes(f"quarantine/{TAR}") == bytes(blob)
    assert not store.exists(TAR)
    assert not find_complete(store, "train", 0)


def test_repair_makes_the_data_set_whole_again(octree_set: Store,
                                               octree_samples: list[tuple[str, Members]]) -> None:
    """A damaged shard, a damaged index, a whole shard: each gets what it needs, and nothing is deleted."""
    whole = {name: octree_set.read_bytes(name) for name in octree_set.list()}
    damaged = bytearray(whole[TAR])
    damaged[5000] ^= 1
    octree_set.put_bytes(TAR, bytes(damaged))
    octree_set.put_bytes("train/shard-000001.json", whole["train/shard-000001.json"][:-7])
    found = [(shard.path, shard.number) for shard in find_damaged(octree_set)]
    assert found == [(TAR, 0), ("train/shard-000001.tar", 1)]
    assert not restore_index(octree_set, "train", "shard-000000.tar")
    assert restore_index(octree_set, "train", "shard-000001.tar")
    assert quarantine(octree_set, TAR) == [f"quarantine/{INDEX}", f"quarantine/{TAR}"]
    assert [shard.problems[0].code for shard in find_damaged(octree_set)] == ["missing"]
    with ShardWriter(octree_set, "train", 0) as writer:  # generation, which is deterministic
        for key, members in octree_samples[:2]:
            writer.add(key, members)
    report = verify(octree_set)
    assert report.ok, report.problems
    assert {name: octree_set.read_bytes(name) for name in whole if not name.startswith("timings/")} == {
        name: data for name, data in whole.items() if not name.startswith("timings/")}
    assert octree_set.read_bytes(f"quarantine/{TAR}") == bytes(damaged)
    quarantine(octree_set, TAR)  # a second time: the first stays
    assert octree_set.exists(f"quarantine/{TAR}.1")
    for path in ("../x", "train/shard-0.tar", "dataset.json", "quarantine/shard-000000.tar"):
        with pytest.raises(OcnfError):
            quarantine(octree_set, path)
    with pytest.raises(OcnfError, match="no such shard"):
        restore_index(octree_set, "train", "shard-000009.tar")


def test_verify_says_what_is_wrong_and_sets_the_exit_status(octree_set: Store) -> None:
    statuses: list[int] = []
    text = shown(lambda console: statuses.append(print_verify(verify(octree_set), console)))
    assert "whole" in text
    assert "4 samples, 20 members" in text
    blob = bytearray((octree_set.root / TAR).read_bytes())
    blob[600] ^= 1
    (octree_set.root / TAR).write_bytes(blob)
    text = shown(lambda console: statuses.append(print_verify(verify(octree_set), console)), width=40)
    assert statuses == [0, 1]
    assert f"{TAR}: chair_0000.json at byte 512: checksum: " in text


def test_info_sums_up_what_the_tars_hold(octree_set: Store,
                                         octree_samples: list[tuple[str, Members]]) -> None:
    summary = describe(octree_set)
    assert {name: (split.shards, dict(split.categories)) for name, split in summary.splits.items()} == {
        "train": (2, {"chair": 3}), "test": (1, {"chair": 1})}
    assert summary.size == sum((octree_set.root / name).stat().st_size for name in octree_set.list()
                               if name.endswith(".tar"))
    for name, part in summary.members.items():
        payloads = [members[name] for _, members in octree_samples]
        assert (part.count, part.size) == (4, sum(map(len, payloads)))
        if name != "json":
            leaves = [json.loads(members["json"])["leaf_counts"][name] for _, members in octree_samples]
            assert (part.leaves, part.fewest, part.most) == (sum(leaves), min(leaves), max(leaves))
            assert 0 < part.fill <= 1
    text = shown(lambda console: print_summary(summary, console))
    for expected in ("tiny", "f00d", "5 inputs = 4 samples + 1 failures", "target-16.oct", "histogram-32"):
        assert expected in text
    octree_set.remove("dataset.json")
    unfinished = describe(octree_set)
    assert unfinished.info is None
    assert unfinished.samples == 4
    assert "unfinished" in shown(lambda console: print_summary(unfinished, console))


def test_a_pipe_in_the_place_of_a_file_is_reported_and_not_opened(opaque_set: Store) -> None:
    """To open one waits for a writer, for ever: without the check this test hangs."""
    assert opaque_set.root is not None
    folder = opaque_set.root
    (folder / "failures").mkdir(exist_ok=True)
    for name in ("plan.json", "failures.jsonl", "failures/train-000009.jsonl"):
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)
    listed = {entry.name for entry in load_dataset(opaque_set).files}
    problems = verify(opaque_set).problems
    assert {problem.file for problem in problems if problem.code == "missing"} == listed
