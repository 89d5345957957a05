"""Promises 6 and 7: whatever lies in the folder, nothing runs, memory stays bounded, the error is ours."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import tarfile
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.files.storage import Store
from ocnf_data.octree import GridOctree
from ocnf_data.octree.codec import decode, encode
from ocnf_data.shards import (
    Counts,
    DatasetInfo,
    ShardEntry,
    ShardIndex,
    ShardReader,
    load_dataset,
    write_dataset,
)
from ocnf_data.shards.walk import index_from_tar
from ocnf_data.verify.verify import verify

Members = dict[str, bytes]
SHARD = "shard-000000.tar"
MB = 2**20


@contextmanager
def bounded_memory(limit: int) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < limit, f"{peak / MB:.0f} MB"


class Planted:
    """A pickle that leaves a file behind when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def member(name: str, data: bytes = b"", **facts: object) -> tuple[tarfile.TarInfo, bytes]:
    info = tarfile.TarInfo(name)
    info.size = len(data)
    for fact, value in facts.items():
        setattr(info, fact, value)
    return info, data


def claim_size(claimed: tuple[tarfile.TarInfo, bytes], size: int) -> tuple[tarfile.TarInfo, bytes]:
    claimed[0].size = size
    return claimed


def tar_of(*members: tuple[tarfile.TarInfo, bytes], tar_format: int = tarfile.USTAR_FORMAT) -> bytes:
    """A tar that another program might have written, claimed sizes included."""
    out = b""
    for info, data in members:
        out += info.tobuf(tar_format, "utf-8", "surrogateescape") + data + bytes(-len(data) % 512)
    return out + bytes(1024)


def plant(store: Store, tar: bytes, n_samples: int = 1, index: bytes | None = None) -> ShardEntry:
    """Publish a tar as an attacker would: with a dataset.json that lists it."""
    store.put_bytes(f"train/{SHARD}", tar)
    if index is not None:
        store.put_bytes("train/shard-000000.json", index)
    entry = ShardEntry(shard=SHARD, size=len(tar), sha256=hashlib.sha256(tar).hexdigest(),
                       index_sha256=hashlib.sha256(index or b"").hexdigest(), samples=n_samples)
    counts = Counts(items=n_samples, samples=n_samples, failures=0, exclusions=0)
    write_dataset(store, DatasetInfo(name="planted", manifest={}, fingerprint="", counts=counts,
                                     splits={"train": (entry,)}))
    return entry


def refused(store: Store, entry: ShardEntry) -> set[str]:
    """Read and verify a planted shard; both must refuse it for what it is. The codes that verify gives."""
    with pytest.raises(OcnfError) as caught, ShardReader(store, "train", entry) as reader:
        list(reader.samples())
    assert caught.value.code != "checksum"  # dataset.json lists it, so hashes are no reason
    report = verify(store)
    assert not report.ok
    return {problem.code for problem in report.problems}


@pytest.fixture
def good(opaque: Callable[[str, dict[str, int]], Members]) -> list[tuple[tarfile.TarInfo, bytes]]:
    members = opaque("chair_0", {"target-16.oct": 700})
    return [member(f"chair_0.{name}", data) for name, data in members.items()]


HOSTILE: dict[str, Callable[[Path], list[tuple[tarfile.TarInfo, bytes]]]] = {
    "pickle": lambda mark: [member("chair_0.pickle", pickle.dumps(Planted(mark)))],
    "pyd": lambda mark: [member("chair_0.pyd", pickle.dumps(Planted(mark)))],
    "nested pyd": lambda mark: [member("chair_0.depth.pyd", pickle.dumps(Planted(mark)))],
    "npy": lambda mark: [member("chair_0.npy", pickle.dumps(Planted(mark)))],
    "command": lambda mark: [member(f"pipe:touch {mark}.json", b"{}")],
    "parent": lambda mark: [member(f"../../{mark.name}", b"x")],
    "absolute": lambda mark: [member(str(mark)[:100], b"x")],
    "symbolic link": lambda mark: [member("chair_0.target-32.oct", type=b"2", linkname="/etc/passwd")],
    "hard link": lambda mark: [member("chair_0.target-32.oct", type=b"1", linkname="/etc/passwd")],
    "character device": lambda mark: [member("chair_0.target-32.oct", type=b"3", devmajor=1, devminor=5)],
    "block device": lambda mark: [member("chair_0.target-32.oct", type=b"4")],
    "folder": lambda mark: [member("chair_1", type=b"5")],
    "fifo": lambda mark: [member("chair_0.target-32.oct", type=b"6")],
    "dotted key": lambda mark: [member("chair.v2_0001.json", b"{}")],
    "duplicate member": lambda mark: [member("chair_0.target-16.oct", b"x")],
    "member of nobody": lambda mark: [member("chair_1.target-16.oct", b"x")],
    "terabyte": lambda mark: [claim_size(member("chair_0.target-32.oct"), 8**11 - 1)],
    "executable": lambda mark: [member("chair_0.target-32.oct", b"x", mode=0o755)],
    "owned": lambda mark: [member("chair_0.target-32.oct", b"x", uid=1000, uname="eve")],
    "dated": lambda mark: [member("chair_0.target-32.oct", b"x", mtime=1_700_000_000)],
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_member_is_refused_and_nothing_runs(tmp_path: Path, kind: str,
                                                      good: list[tuple[tarfile.TarInfo, bytes]]) -> None:
    mark = tmp_path / "owned"
    planted = HOSTILE[kind](mark)
    with bounded_memory(20 * MB):
        for tar in (tar_of(*good, *planted), tar_of(*planted, *good), tar_of(*planted)):
            refused(store := Store(tmp_path / "set"), plant(store, tar))
    assert not mark.exists()


@pytest.mark.parametrize("tar_format", [tarfile.PAX_FORMAT, tarfile.GNU_FORMAT])
def test_extended_headers_are_refused(tmp_path: Path, good: list[tuple[tarfile.TarInfo, bytes]],
                                      tar_format: int) -> None:
    """A PAX path or a GNU long name would rename the member that follows, whatever its own header says."""
    headers = {"path": "../../evil", "size": "9999999999"}
    long_name = member("../" * 40 + "etc/passwd", b"x", pax_headers=headers)
    store = Store(tmp_path)
    codes = refused(store, plant(store, tar_of(*good, long_name, tar_format=tar_format)))
    assert "header" in codes


def test_interleaved_and_repeated_samples_are_refused(
    tmp_path: Path, opaque: Callable[[str, dict[str, int]], Members]
) -> None:
    sizes = {"target-16.oct": 9, "target-32.oct": 9}
    a, b = ([member(f"{key}.{name}", data) for name, data in opaque(key, sizes).items()] for key in "ab")
    store = Store(tmp_path)
    for order in ([a[0], b[0], a[1], b[1], a[2], b[2]], [*a[:2], *b, a[2]], [*a, *a], [*a, *b, *a],
                  [a[1], a[0], a[2]], [a[0], a[1]], [a[0], a[0], *a[1:]]):
        assert refused(store, plant(store, tar_of(*order), 2)) & {"layout", "json"}
    index = index_from_tar(io.BytesIO(tar_of(*a, *b)), "train", SHARD, "tar")  # the honest order is fine
    assert [sample.key for sample in index.samples] == ["a", "b"]


def test_what_follows_the_end_is_refused(tmp_path: Path, good: list[tuple[tarfile.TarInfo, bytes]]) -> None:
    """Python's tarfile stops at the first zero block, others read on: what one tool sees, all must see."""
    store = Store(tmp_path)
    for tail in (tar_of(*good), bytes(512), b"\0"):
        assert "trailer" in refused(store, plant(store, tar_of(*good) + tail))
    for cut in (1, 512, 1024):
        refused(store, plant(store, tar_of(*good)[:-cut]))


def test_hidden_bytes_in_the_padding_are_refused(tmp_path: Path,
                                                 good: list[tuple[tarfile.TarInfo, bytes]]) -> None:
    tar = bytearray(tar_of(*good))
    tar[1023] = 1
    store = Store(tmp_path)
    assert "padding" in refused(store, plant(store, bytes(tar)))


def test_a_link_behind_an_honest_index_is_refused(tmp_path: Path,
                                                  good: list[tuple[tarfile.TarInfo, bytes]]) -> None:
    """The attacker controls all three files: sizes and hashes agree, only the header is that of a link."""
    tar = tar_of(*good)
    index = index_from_tar(io.BytesIO(tar), "train", SHARD, "tar")
    link, _ = member("chair_0.target-16.oct", type=b"2", linkname="/etc/passwd")
    link.size = 700
    start = index.samples[0].members[1].offset - 512
    tar = tar[:start] + link.tobuf(tarfile.USTAR_FORMAT) + tar[start + 512:]
    described = index.model_copy(update={"sha256": hashlib.sha256(tar).hexdigest()}).to_json()
    store = Store(tmp_path)
    assert "header" in refused(store, plant(store, tar, index=described))


def bomb(size: int) -> bytes:
    """A zstd frame of `size` zeros without saying so."""
    compressor = zstandard.ZstdCompressor(level=19, write_content_size=False).compressobj()
    return b"".join([*(compressor.compress(bytes(MB)) for _ in range(size // MB)), compressor.flush()])


def lying_payloads() -> dict[str, bytes]:
    octree = GridOctree.from_dense(np.linspace(-1, 1, 4096, dtype=np.float32).reshape(1, 16, 16, 16))
    whole = encode(octree, "target")
    content = bytearray(zstandard.decompress(whole))
    contradiction = bytearray(content)
    contradiction[8 + int.from_bytes(content[:8], "little")] ^= 1  # the root of the first tree
    compress = zstandard.ZstdCompressor(write_checksum=True).compress
    claim = {"trees": {"dtype": "U8", "shape": [2**30, 2**10], "data_offsets": [0, 2**40]}}
    huge = json.dumps(claim).encode()
    return {
        "zstd bomb": bomb(512 * MB),
        "safetensors that claims a terabyte": compress(len(huge).to_bytes(8, "little") + huge),
        "header that claims a terabyte": compress((2**40).to_bytes(8, "little") + b"{}"),
        "bits that contradict the leaf count": compress(bytes(contradiction)),
        "another safetensors": compress(save({"trees": np.zeros((2, 2, 2, 10), np.uint8)})),
        "another kind": encode(octree, "tsdf"),
        "another resolution": encode(GridOctree.from_dense(np.zeros((1, 8, 8, 8), np.float32)), "target"),
        "pickle": pickle.dumps(octree.data),
        "two frames": whole + whole,
        "nothing": b"",
    }


LIES = lying_payloads()


@pytest.mark.parametrize("lie", LIES)
def test_a_member_that_lies_is_one_row_of_verify(tmp_path: Path, lie: str, write_set: Callable[..., Store],
                                                 sample_json: Callable[..., bytes]) -> None:
    """Checksums all right, contents wrong: what was written was wrong to begin with."""
    try:  # where it is an octree, the count is right: only kind and resolution are not those of the name
        leaves = decode(LIES[lie]).n_leaves
    except OcnfError:
        leaves = 8
    members = {"json": sample_json("a", {"target-16.oct": leaves}), "target-16.oct": LIES[lie]}
    store = write_set({"train": [[("a", members)]]})
    with bounded_memory(20 * MB):
        report = verify(store)
    assert {(p.key, p.member) for p in report.problems} == {("a", "target-16.oct")}, report.problems


def test_json_that_contradicts_the_index_is_reported(tmp_path: Path, octree_set: Store) -> None:
    """An index can be swapped where no dataset.json checks it yet; the tar contradicts it."""
    octree_set.remove("dataset.json")
    path = octree_set.root / "train/shard-000000.json"
    raw = json.loads(path.read_bytes())
    raw["samples"][0]["category"] = "throne"
    raw["samples"][1]["leaf_counts"]["target-16.oct"] += 1
    path.write_bytes(canonical_json(raw))
    rows = {(p.key, p.member, p.code) for p in verify(octree_set).problems}
    assert rows >= {("chair_0000", "json", "json"), ("chair_0001", "json", "json"),
                    ("chair_0001", "target-16.oct", "octree")}


def hostile_indices(raw: dict[str, object]) -> Iterator[tuple[str, dict[str, object]]]:
    def changed(path: tuple[object, ...], value: object) -> dict[str, object]:
        copy = json.loads(json.dumps(raw))
        place = copy
        for step in path[:-1]:
            place = place[step]
        place[path[-1]] = value
        return copy

    first = ("samples", 0, "members", 0)
    for value in (-1, 0, 511, 513, 2**62, 10**30, 512.0, "512", None, [512], True):
        yield f"offset {value}", changed((*first, "offset"), value)
    for value in (-1, 2**31, 2**62, 10**400, 1.5, "9", None):
        yield f"size {value}", changed((*first, "size"), value)
    for value in ("", "0" * 63, "g" * 64, "A" * 64, 7, None):
        yield f"sha256 {value}", changed((*first, "sha256"), value)
    for value in ("json2", "../json", "target-16.oct", "pyd", "", 3):
        yield f"name {value}", changed((*first, "name"), value)
    for value in ("../x", "a.b", "", "chair_0001", 5, None, "a" * 65):
        yield f"key {value}", changed(("samples", 0, "key"), value)
    for value in (-1, 10**12, "1"):
        yield f"whole size {value}", changed(("size",), value)
    for value in ("..", "train/../..", "", 4):
        yield f"split {value}", changed(("split",), value)
    for value in ("../shard-000000.tar", "shard-0.tar", "pipe:ls", ""):
        yield f"shard {value}", changed(("shard",), value)
    for value in (0, 2, "1", None, 1.0, True):
        yield f"schema {value}", changed(("schema",), value)
    yield "no members", changed(("samples", 0, "members"), [])
    yield "samples a dict", changed(("samples",), {})
    yield "extra field", changed(("extra",), 1)
    yield "leaf counts of others", changed(("samples", 0, "leaf_counts"), {"target-999.oct": 1})
    yield "huge leaf count", changed(("samples", 0, "leaf_counts", "target-16.oct"), 2**40)


def test_hostile_indices_are_refused(octree_set: Store) -> None:
    raw = json.loads(octree_set.read_bytes("train/shard-000000.json"))
    tried = 0
    for what, index in hostile_indices(raw):
        with pytest.raises(OcnfError):
            ShardIndex.from_json(canonical_json(index), what)
        tried += 1
    assert tried > 50
    blob = octree_set.read_bytes("train/shard-000000.json")
    for text in (b"", b"null", b"[]", b"[" * 200_000, b'{"a":' * 100_000, blob + b" ", b" " + blob, blob * 2,
                 blob.replace(b'"schema":1', b'"schema":1,"schema":1'), b'"\\ud800"', b"\xef\xbb\xbf" + blob,
                 b'{"size":' + b"9" * 100_000 + b"}"):
        with pytest.raises(OcnfError):
            ShardIndex.from_json(text, "index")


def test_an_index_too_large_is_not_read(octree_set: Store) -> None:
    with (octree_set.root / "train/shard-000000.json").open("wb") as file:
        file.truncate(2**40)  # sparse
    with (octree_set.root / "train/shard-000001.tar").open("ab") as file:
        file.truncate(2**40)
    entry = load_dataset(octree_set).splits["train"][0]
    with bounded_memory(20 * MB), pytest.raises(OcnfError):
        ShardReader(octree_set, "train", entry).read(0)


def test_commands_and_links_are_not_opened(tmp_path: Path) -> None:
    for url in (f"pipe:touch {tmp_path}/owned", f"pipe://touch {tmp_path}/owned", "memory://a::file:///etc"):
        with pytest.raises(OcnfError):
            load_dataset(url)
    assert not (tmp_path / "owned").exists()


FIELDS = st.sampled_from([
    "schema", "split", "shard", "size", "sha256", "samples", "key", "category", "source", "members", "name",
    "leaf_counts", "offset", "counts", "splits", "files", "manifest", "fingerprint", "checksum"])
JSON_LIKE = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(FIELDS, inner))


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.binary(max_size=300) | JSON_LIKE.map(lambda value: json.dumps(value).encode()))
def test_parsers_give_our_error_and_nothing_else(blob: bytes) -> None:
    for parser in (ShardIndex, DatasetInfo):
        with pytest.raises(OcnfError):
            parser.from_json(blob, "fuzz")


@given(st.data())
def test_a_mutated_tar_is_refused_or_is_canonical(data: st.DataObject) -> None:
    """Blocks of a tar shuffled, repeated, dropped, edited: OcnfError, or the tar that its index describes."""
    facts = {"key": "a", "category": "c", "source": "s", "leaf_counts": {"target-16.oct": 1}}
    tar = tar_of(member("a.json", json.dumps(facts).encode()), member("a.target-16.oct", b"x" * 600))
    blocks = [tar[start:start + 512] for start in range(0, len(tar), 512)]
    order = range(len(blocks))
    picked = data.draw(st.lists(st.sampled_from(order), max_size=10) | st.just(order))
    mutated = bytearray(b"".join(blocks[i] for i in picked))
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), max_size=3)):
        if place < len(mutated):
            mutated[place] = value
    try:
        index = index_from_tar(io.BytesIO(bytes(mutated)), "train", SHARD, "fuzz")
    except OcnfError:
        return
    assert index.size == len(mutated)
    assert index.sha256 == hashlib.sha256(mutated).hexdigest()
