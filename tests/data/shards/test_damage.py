"""Promise 4: any cut and any flipped bit is caught, by the reader and by `verify`."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.shards import DatasetInfo, ShardIndex, ShardReader, load_dataset
from ocnf_data.shards.tarformat import BLOCK
from ocnf_data.verify.verify import verify

TAR, INDEX = "train/shard-000000.tar", "train/shard-000000.json"


@contextmanager
def damaged(path: Path, data: bytes) -> Iterator[None]:
    whole = path.read_bytes()
    path.write_bytes(data)
    try:
        yield
    finally:
        path.write_bytes(whole)


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def read_everything(store: Store) -> int:
    """What a careful user does: all members of all samples of all shards. The number of members."""
    n_members = 0
    for split, entry in load_dataset(store).shards():
        with ShardReader(store, split, entry) as reader:
            n_members += sum(len(members) for _, members in reader.samples())
    return n_members


def reader_notices(store: Store) -> str | None:
    """The code of the reader's error, None if it noticed nothing."""
    try:
        read_everything(store)
    except OcnfError as error:
        return error.code
    return None


def test_the_data_set_is_whole_to_begin_with(octree_set: Store) -> None:
    assert read_everything(octree_set) == 4 * 5
    report = verify(octree_set)
    assert report.ok, report.problems
    assert (report.shards, report.samples, report.members, report.notes) == (3, 4, 20, [])


def test_cut_at_every_block(opaque_set: Store, octree_set: Store) -> None:
    for store in (opaque_set, octree_set):
        path = store.root / TAR
        whole = path.read_bytes()
        for end in range(0, len(whole), BLOCK):
            with damaged(path, whole[:end]):
                assert reader_notices(store) == "truncated", end
    for end in range(0, len(whole), 4 * BLOCK):  # verify decodes every octree, so fewer cuts
        with damaged(path, whole[:end]):
            report = verify(octree_set)
        assert {problem.file for problem in report.problems} >= {TAR}, end
        assert any(problem.code == "truncated" for problem in report.problems), end


def test_a_wrong_size_is_noticed_with_the_first_sample(opaque_set: Store) -> None:
    """Before a week of training has come to the sample that is gone."""
    path = opaque_set.root / TAR
    whole = path.read_bytes()
    entry = load_dataset(opaque_set).splits["train"][0]
    for data, code in ((whole[:-1], "truncated"), (whole + bytes(512), "size")):
        with damaged(path, data), ShardReader(opaque_set, "train", entry) as reader:
            with pytest.raises(OcnfError) as caught:
                reader.read(0, ["json"])
            assert caught.value.code == code
    with damaged(path, whole + bytes(512)):
        assert ("trailer", len(whole)) in {(p.code, p.offset) for p in verify(opaque_set).problems}


def test_cut_in_the_middle_is_found_where_it_happens_if_the_size_is_hidden(octree_set: Store) -> None:
    """A cut made good with zeros, so that no size betrays it: at every block."""
    path = octree_set.root / TAR
    whole = path.read_bytes()
    entry = load_dataset(octree_set).splits["train"][0]
    for end in range(0, len(whole) - 2 * BLOCK, BLOCK):
        with damaged(path, whole[:end] + bytes(len(whole) - end)):
            if whole[end:].count(0) == len(whole) - end:
                continue
            with pytest.raises(OcnfError) as caught, ShardReader(octree_set, "train", entry) as reader:
                list(reader.samples())
            assert caught.value.code in ("header", "checksum")


def bits_to_flip(index: ShardIndex, size: int) -> dict[str, list[int]]:
    """Bits by kind of place: in all bytes of a header, in some of every header, payload and padding."""
    dice = random.Random(0)
    bits: dict[str, list[int]] = {"header": [], "payload": [], "padding": [], "trailer": []}
    fields = (0, 100, 108, 116, 124, 136, 148, 156, 157, 257, 263, 265, 297, 329, 337, 345, 511)
    for number, sample in enumerate(index.samples):
        for member in sample.members:
            header, end = member.offset - BLOCK, member.offset + member.size
            places = range(BLOCK) if number == 0 and member.name == "json" else fields
            bits["header"] += [8 * (header + byte) + dice.randrange(8) for byte in places]
            bits["payload"] += [8 * member.offset, 8 * end - 1, dice.randrange(8 * member.offset, 8 * end)]
            if pad := -end % BLOCK:
                bits["padding"] += [8 * end, 8 * (end + pad) - 1]
    trailer = range(8 * (size - 2 * BLOCK), 8 * size)
    bits["trailer"] = [trailer[0], trailer[-1], *dice.sample(trailer, 9)]
    return bits


def test_a_flipped_bit_anywhere_in_a_tar(octree_set: Store) -> None:
    path = octree_set.root / TAR
    whole = path.read_bytes()
    index = ShardIndex.from_json((octree_set.root / INDEX).read_bytes(), INDEX)
    entry = load_dataset(octree_set).splits["train"][0]
    expected = {"header": "header", "payload": "checksum", "padding": "padding", "trailer": "trailer"}
    tried = 0
    for place, bits in bits_to_flip(index, len(whole)).items():
        assert bits, place
        for bit in bits:
            with damaged(path, flipped(whole, bit)):
                with pytest.raises(OcnfError) as caught, ShardReader(octree_set, "train", entry) as reader:
                    list(reader.samples())
                assert caught.value.code == expected[place], (place, bit)
                assert TAR in str(caught.value)
                tried += 1
    assert tried > 700


def test_verify_names_shard_key_member_and_byte_of_each_flipped_bit(octree_set: Store) -> None:
    path = octree_set.root / TAR
    whole = path.read_bytes()
    index = ShardIndex.from_json((octree_set.root / INDEX).read_bytes(), INDEX)
    for sample in index.samples:
        for member in sample.members:
            places = {"header": member.offset - BLOCK + 3, "checksum": member.offset + member.size // 2}
            if member.size % BLOCK:
                places["padding"] = member.offset + member.size
            for code, byte in places.items():
                with damaged(path, flipped(whole, 8 * byte)):
                    problems = [p for p in verify(octree_set).problems if p.code == code]
                assert [(p.file, p.key, p.member) for p in problems] == [(TAR, sample.key, member.name)]
                assert problems[0].offset <= byte


def test_verify_finds_all_of_several_damages(octree_set: Store) -> None:
    """Two members of one shard, the trailer of another, a lost shard: all are named in one report."""
    path, other = octree_set.root / TAR, octree_set.root / "train/shard-000001.tar"
    index = ShardIndex.from_json((octree_set.root / INDEX).read_bytes(), INDEX)
    first, second = index.samples[0].members[1], index.samples[1].members[4]
    data = flipped(flipped(path.read_bytes(), 8 * first.offset), 8 * second.offset + 7)
    path.write_bytes(data)
    other.write_bytes(other.read_bytes()[:-1] + b"\1")
    (octree_set.root / "test/shard-000000.tar").unlink()
    report = verify(octree_set)
    found = {(p.file, p.key, p.member, p.code) for p in report.problems}
    assert found >= {
        (TAR, index.samples[0].key, first.name, "checksum"),
        (TAR, index.samples[1].key, second.name, "checksum"),
        (TAR, None, None, "sha256"), ("train/shard-000001.tar", None, None, "trailer"),
        ("test/shard-000000.tar", None, None, "missing")}
    assert report.damaged_shards == ["test/shard-000000.tar", TAR, "train/shard-000001.tar"]


def test_a_flipped_bit_anywhere_in_an_index(opaque_set: Store) -> None:
    path = opaque_set.root / INDEX
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), 53):
        with damaged(path, flipped(whole, bit)):
            assert reader_notices(opaque_set) == "checksum", bit


def test_verify_catches_a_flipped_bit_in_every_other_file(octree_set: Store) -> None:
    dice = random.Random(1)
    for name in ("dataset.json", "failures.jsonl", INDEX):
        path = octree_set.root / name
        whole = path.read_bytes()
        for _ in range(12):
            with damaged(path, flipped(whole, dice.randrange(8 * len(whole)))):
                assert not verify(octree_set).ok
        for end in (0, 1, len(whole) // 2, len(whole) - 1):
            with damaged(path, whole[:end]):
                assert not verify(octree_set).ok
    assert verify(octree_set).ok


def test_a_flipped_bit_anywhere_in_dataset_json(opaque_set: Store) -> None:
    whole = opaque_set.read_bytes("dataset.json")
    for bit in range(0, 8 * len(whole), 3):
        with pytest.raises(OcnfError):
            DatasetInfo.from_json(flipped(whole, bit), "dataset.json")


def test_what_is_not_asked_for_is_not_checked(opaque_set: Store) -> None:
    """The documented limit of reading some members only."""
    path = opaque_set.root / TAR
    index = ShardIndex.from_json((opaque_set.root / INDEX).read_bytes(), INDEX)
    entry = load_dataset(opaque_set).splits["train"][0]
    with damaged(path, flipped(path.read_bytes(), 8 * index.samples[0].members[1].offset)), \
            ShardReader(opaque_set, "train", entry) as reader:
        assert list(reader.read(0, ["json"])) == ["json"]
        with pytest.raises(OcnfError, match=r"chair_0000\.target-64\.oct at byte 1536"):
            reader.read(0, ["target-64.oct"])


def test_a_shard_in_the_place_of_another_is_noticed(octree_set: Store) -> None:
    """Whole shards, whole indices, wrong places: no checksum inside them can tell, dataset.json does."""
    for suffix in ("tar", "json"):
        a, b = (octree_set.root / f"train/shard-00000{number}.{suffix}" for number in (0, 1))
        one, two = a.read_bytes(), b.read_bytes()
        a.write_bytes(two)
        b.write_bytes(one)
    assert reader_notices(octree_set)
    assert verify(octree_set).damaged_shards == [TAR, "train/shard-000001.tar"]


def test_lost_index_is_made_anew_only_for_the_shard_that_was_written(
    opaque_set: Store, opaque: Callable[..., dict[str, bytes]]
) -> None:
    entry = load_dataset(opaque_set).splits["train"][0]
    index = (opaque_set.root / INDEX).read_bytes()
    (opaque_set.root / INDEX).unlink()
    reader = ShardReader(opaque_set, "train", entry)
    assert reader.index.to_json() == index
    assert read_everything(opaque_set) == 3 + 2 + 2 + 2
    path = opaque_set.root / TAR
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), 8 * 97 + 1):
        with damaged(path, flipped(whole, bit)), pytest.raises(OcnfError):
            ShardReader(opaque_set, "train", entry).index  # noqa: B018
