"""A catalogue says exactly what the indices say, in bytes that follow from them; anything else is refused."""

from __future__ import annotations

import json
import random
import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load as load_safetensors

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.shards import load_dataset
from ocnf_data.shards.browse import find_sample, stored_samples
from ocnf_data.shards.catalogue import Keys, ShardContents, SplitCatalogue, load_catalogue
from ocnf_data.shards.index import catalogue_path
from ocnf_data.verify.repair import restore_catalogues
from ocnf_data.verify.verify import verify

Members = dict[str, bytes]
GOLDEN = Path(__file__).parent / "golden-v1"
KEYS = st.text("abcXYZ019_-", min_size=1, max_size=64)
LISTS = st.sampled_from([("json",), ("json", "target-64.oct"), ("json", "target-64.oct", "v4-tsdf-64.oct")])
SAMPLES = st.tuples(KEYS, st.sampled_from(["chair", "lamp", "été \"x\"", ""]), LISTS)
SHARDS = st.lists(st.lists(SAMPLES, max_size=4), max_size=5)


def catalogue_of(shards: list[list[tuple[str, str, tuple[str, ...]]]]) -> SplitCatalogue:
    return SplitCatalogue.of("train", [
        ShardContents(Keys.of(key for key, _, _ in shard).text, tuple(category for _, category, _ in shard),
                      tuple(names for _, _, names in shard)) for shard in shards])


def told(catalogue: SplitCatalogue) -> list[list[tuple[str, str, tuple[str, ...]]]]:
    """What a catalogue says, in plain words."""
    rows = zip(catalogue.keys, catalogue.category_of.tolist(), catalogue.members_of.tolist(), strict=True)
    rows = iter([(key, catalogue.categories[c], catalogue.members[m]) for key, c, m in rows])
    return [[next(rows) for _ in range(n)] for n in catalogue.samples.tolist()]


@given(SHARDS)
def test_it_says_what_the_shards_hold(shards) -> None:
    catalogue = catalogue_of(shards)
    assert told(catalogue) == shards
    blob = catalogue.to_bytes()
    again = SplitCatalogue.from_bytes(blob, "there")
    assert told(again) == shards
    assert again.to_bytes() == blob == catalogue_of(shards).to_bytes()
    arrays = load_safetensors(blob)  # and anyone reads it, without this package
    meta = json.loads(json.loads(blob[8 : 8 + int.from_bytes(blob[:8], "little")])["__metadata__"]["ocnf"])
    keys = arrays["keys"].tobytes().decode().split("\n")[:-1]
    assert keys == [key for shard in shards for key, _, _ in shard]
    categories = [meta["categories"][place] for place in arrays["categories"]]
    assert categories == [category for shard in shards for _, category, _ in shard]
    members = [tuple(meta["members"][place]) for place in arrays["members"]]
    assert members == [names for shard in shards for _, _, names in shard]
    assert arrays["samples"].tolist() == [len(shard) for shard in shards]


@given(st.lists(KEYS, max_size=12), st.data())
def test_keys_are_a_list_of_keys(names, data) -> None:
    keys = Keys.of(names)
    assert (list(keys), len(keys)) == (names, len(names))
    assert keys.lengths().tolist() == [len(name) for name in names]
    for place in range(-len(names), len(names)):
        assert keys[place] == names[place]
    for place in (len(names), -len(names) - 1):
        with pytest.raises(IndexError):
            keys[place]
    chosen = data.draw(st.lists(st.booleans(), min_size=len(names), max_size=len(names)))
    assert list(keys.take(np.array(chosen, np.bool_))) == [n for n, c in zip(names, chosen, strict=True) if c]
    for name in (*names, "a", "nobody"):
        assert keys.find(name) == (names.index(name) if name in names else None)


def test_it_finds_what_a_scan_finds(octree_set: Store) -> None:
    restore_catalogues(octree_set)
    for sample in stored_samples(octree_set):
        found = find_sample(octree_set, sample.key)
        assert (found.split, found.position, found.entry) == (sample.split, sample.position, sample.entry)
        assert found.reader.path == sample.reader.path
        assert found.facts["key"] == sample.key
    with pytest.raises(OcnfError, match="no such sample"):
        find_sample(octree_set, "chair_000")


def test_it_is_made_from_the_indices_and_adds_nothing_else(octree_set: Store) -> None:
    before = {name: octree_set.read_bytes(name) for name in octree_set.list()}
    info = load_dataset(octree_set)
    assert restore_catalogues(octree_set) == [catalogue_path(split) for split in info.splits]
    after = load_dataset(octree_set)
    assert after.model_copy(update={"files": info.files, "checksum": info.checksum}) == info
    assert after.identity == info.identity == info.checksum != after.checksum
    for name, data in before.items():
        assert octree_set.read_bytes(name) == data or name == "dataset.json"
    report = verify(octree_set)
    assert report.ok, report.problems
    assert restore_catalogues(octree_set) == []
    assert told(load_catalogue(octree_set, after, "train")) == [
        [(sample.key, "chair", tuple(member.name for member in sample.entry.members))
         for sample in stored_samples(octree_set) if sample.reader.path == f"train/shard-00000{number}.tar"]
        for number in (0, 1)]


def test_the_golden_set_gains_one_and_stays_the_same_data_set(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN, tmp_path / "set")
    before = load_dataset(str(GOLDEN))
    restore_catalogues(str(tmp_path / "set"))
    now = load_dataset(str(tmp_path / "set"))
    assert (now.identity, now.splits) == (before.checksum, before.splits)
    assert now.schema_version == 1
    assert verify(str(tmp_path / "set")).ok
    assert (tmp_path / "set" / "train" / "catalogue.safetensors").read_bytes() == SplitCatalogue.of(
        "train", [ShardContents(b"chair_0000\nchair_0001\n", ("chair", "chair"),
                                (("json", "target-16.oct", "v4_n02-histogram-16.oct"),) * 2)]).to_bytes()


def test_verify_finds_a_flipped_bit_a_cut_and_a_stranger(octree_set: Store) -> None:
    restore_catalogues(octree_set)
    name = catalogue_path("train")
    whole = octree_set.read_bytes(name)
    dice = random.Random(0)
    damages = [whole[:-1], b"", whole + b"\0"]
    for _ in range(9):
        bit = dice.randrange(8 * len(whole))
        changed = bytearray(whole)
        changed[bit // 8] ^= 1 << bit % 8
        damages.append(bytes(changed))
    for data in damages:
        octree_set.put_bytes(name, data)
        assert [(row.file, row.code) for row in verify(octree_set).problems] == [(name, "sha256")]
        assert restore_catalogues(octree_set) == [name]
        assert octree_set.read_bytes(name) == whole
    octree_set.put_bytes("train/catalogue.json", b"{}")
    problems = verify(octree_set).problems
    assert [(row.file, row.code) for row in problems] == [("train/catalogue.json", "extra")]


def test_a_catalogue_before_its_dataset_json_is_no_stranger(octree_set: Store) -> None:
    """A run that was killed between the two."""
    restore_catalogues(octree_set)
    octree_set.remove("dataset.json")
    assert [(row.file, row.code) for row in verify(octree_set).problems] == [("dataset.json", "missing")]


def crafted(change: Callable[[dict, dict], None], body: bytes | None = None) -> bytes:
    """A catalogue of two samples whose header says something else."""
    blob = catalogue_of([[("a", "chair", ("json",)), ("b", "lamp", ("json", "target-64.oct"))]]).to_bytes()
    length = int.from_bytes(blob[:8], "little")
    header = json.loads(blob[8 : 8 + length])
    meta = json.loads(header["__metadata__"]["ocnf"])
    change(header, meta)
    if "__metadata__" in header:
        header["__metadata__"]["ocnf"] = json.dumps(meta, sort_keys=True, separators=(",", ":"))
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + (blob[8 + length :] if body is None else body)


def numbers(*values: int) -> bytes:
    return np.array(values, "<u4").tobytes()


def sized(header: dict, n_shards: int, n_samples: int, n_text: int) -> None:
    start = 0
    for name, width, count in (("samples", 4, n_shards), ("categories", 4, n_samples),
                               ("members", 4, n_samples), ("keys", 1, n_text)):
        header[name] |= {"shape": [count], "data_offsets": [start, start + width * count]}
        start += width * count


HOSTILE: dict[str, bytes] = {
    "nothing": b"",
    "no header": b"\xff" * 8,
    "header of a terabyte": (2**40).to_bytes(8, "little") + b"{}",
    "no JSON": (8).to_bytes(8, "little") + b"[" * 8,
    "deep JSON": (200_000).to_bytes(8, "little") + b"[" * 200_000,
    "no metadata": crafted(lambda header, meta: header.pop("__metadata__")),
    "another version": crafted(lambda header, meta: meta.update(version=2)),
    "another field": crafted(lambda header, meta: meta.update(more=1)),
    "another tensor": crafted(lambda header, meta: header.update(more=header["keys"])),
    "a split of another kind": crafted(lambda header, meta: meta.update(split="../train")),
    "samples of a terabyte": crafted(lambda header, meta: sized(header, 1, 2**38, 4)),
    "a negative count": crafted(lambda header, meta: sized(header, 1, -1, 12)),
    "a count that is none": crafted(lambda header, meta: header["samples"].update(shape=[1.0])),
    "fewer samples": crafted(lambda header, meta: sized(header, 1, 1, 4)),
    "more samples than in the shards": crafted(lambda header, meta: None,
                                               numbers(1) + numbers(0, 1, 0, 1) + b"a\nb\n"),
    "samples that overflow": crafted(lambda header, meta: sized(header, 2, 2, 4),
                                     numbers(2**32 - 1, 3) + numbers(0, 1, 0, 1) + b"a\nb\n"),
    "a category that is not listed": crafted(lambda header, meta: None,
                                             numbers(2) + numbers(0, 2, 0, 1) + b"a\nb\n"),
    "a category that nobody uses": crafted(lambda header, meta: None,
                                           numbers(2) + numbers(0, 0, 0, 1) + b"a\nb\n"),
    "categories in another order": crafted(lambda header, meta: None,
                                           numbers(2) + numbers(1, 0, 0, 1) + b"a\nb\n"),
    "a list that is not listed": crafted(lambda header, meta: None,
                                         numbers(2) + numbers(0, 1, 0, 2**32 - 1) + b"a\nb\n"),
    "the same category twice": crafted(lambda header, meta: meta.update(categories=["chair", "chair"])),
    "a category that is no text": crafted(lambda header, meta: meta.update(categories=["chair", 7])),
    "an endless category": crafted(lambda header, meta: meta.update(categories=["chair", "x" * 2000])),
    "categories that are a text": crafted(lambda header, meta: meta.update(categories="ab")),
    "a member that a sample may not have": crafted(
        lambda header, meta: meta.update(members=[["json"], ["json", "depth.pyd"]])),
    "members without json": crafted(lambda header, meta: meta.update(members=[["json"], ["target-64.oct"]])),
    "no members": crafted(lambda header, meta: meta.update(members=[["json"], []])),
    "a dot in a key": crafted(lambda header, meta: None, numbers(2) + numbers(0, 1, 0, 1) + b".\nb\n"),
    "an empty key": crafted(lambda header, meta: None, numbers(2) + numbers(0, 1, 0, 1) + b"\nab\n"),
    "a key too few": crafted(lambda header, meta: None, numbers(2) + numbers(0, 1, 0, 1) + b"a_b\n"),
    "a key without an end": crafted(lambda header, meta: None, numbers(2) + numbers(0, 1, 0, 1) + b"\na\nb"),
    "a key too long": crafted(lambda header, meta: sized(header, 1, 2, 68),
                              numbers(2) + numbers(0, 1, 0, 1) + b"a\n" + b"b" * 65 + b"\n"),
    "a tail": crafted(lambda header, meta: None) + b"\0",
}


def test_what_is_crafted_is_read_where_nothing_is_changed() -> None:
    blob = crafted(lambda header, meta: None)
    assert SplitCatalogue.from_bytes(blob, "there").to_bytes() == blob
    same = numbers(2) + numbers(0, 1, 0, 1) + b"a\nb\n"
    assert crafted(lambda header, meta: None, same) == blob


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_catalogue_is_refused(what: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(OcnfError, match="there: ") as caught:
            SplitCatalogue.from_bytes(HOSTILE[what], "there")
        assert tracemalloc.get_traced_memory()[1] < 20 * 2**20
    finally:
        tracemalloc.stop()
    assert caught.value.code == "catalogue"


@given(SHARDS, st.data())
def test_any_bytes_are_refused_or_are_the_bytes_of_a_catalogue(shards, data) -> None:
    blob = bytearray(catalogue_of(shards).to_bytes())
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(blob) - 1), st.integers(0, 255)),
                                           max_size=3)):
        blob[place] = value
    mutated = bytes(blob[: data.draw(st.integers(len(blob) - 3, len(blob)))])
    try:
        catalogue = SplitCatalogue.from_bytes(mutated, "there")
    except OcnfError:
        return
    assert catalogue.to_bytes() == mutated


def test_a_catalogue_of_other_shards_is_refused(octree_set: Store) -> None:
    """Whole and listed, and no contradiction to an index shows until one is read."""
    restore_catalogues(octree_set)
    info = load_dataset(octree_set)
    wrong = info.model_copy(update={"splits": {**info.splits, "train": info.splits["train"][::-1]}})
    with pytest.raises(OcnfError, match="a catalogue of other shards"):
        load_catalogue(octree_set, wrong, "train")
