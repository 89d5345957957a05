"""Keys, order and shards are fixed before anything is made."""

from __future__ import annotations

import re
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.generation import generate
from ocnf_data.generation.plan import Plan, make_keys, make_plan
from ocnf_data.generation.records import Failure, Item, ShardPlan
from ocnf_data.manifest import Entry
from ocnf_data.shards.tarformat import MAX_NAME, check_key, tar_name


def keys(*paths: str, **kwargs: int) -> list[str]:
    return make_keys([Entry("train", path.split("/")[0], path) for path in paths], **kwargs)


def test_readable_keys() -> None:
    assert keys("chair/train/chair_0001.off", "car/train/m123.obj") == ["chair_0001", "car-train-m123"]
    assert make_keys([Entry("val", "mug", index=7)]) == ["mug-val-0007"]
    assert make_keys([Entry("train", "mug", "a/b.ply", key="my-mug")]) == ["my-mug"]


def test_odd_names_get_a_digest() -> None:
    odd = keys("car/train/m 1.obj", "car/train/m.1.obj", "car/train/m_1.obj")
    assert len(set(odd)) == 3
    assert all(re.fullmatch(r"car-train-m_1-[0-9a-f]{8}", key) for key in odd)
    assert odd[:1] == keys("car/train/m 1.obj"), "the digest is of the path alone"


def test_keys_that_differ_in_case_only() -> None:
    assert len({key.lower() for key in keys("car/train/A.obj", "car/train/a.obj", "car/train/b.obj")}) == 3


def test_one_name_in_two_folders() -> None:
    found = keys("chair/train/chair_1.off", "chair/test/chair_1.off")
    assert len(set(found)) == 2
    assert all(key.startswith("chair_1-") for key in found)


def test_given_keys_that_clash() -> None:
    entries = [Entry("train", "mug", "a.ply", key="Mug"), Entry("test", "mug", "b.ply", key="mug")]
    with pytest.raises(OcnfError, match="two items have the same key"):
        make_keys(entries)
    with pytest.raises(OcnfError, match="a key is too long"):
        make_keys([Entry("train", "mug", "a.ply", key="m" * 40)], limit=39)


@given(st.lists(st.text(st.characters(codec="utf-8", exclude_characters="/\0"), min_size=1, max_size=90),
                unique=True, min_size=1, max_size=8), st.integers(24, 64))
def test_any_file_name_gets_a_key_of_its_own(names: list[str], limit: int) -> None:
    found = keys(*(f"chair/train/{name}.off" for name in names), limit=limit)
    assert max(Counter(key.lower() for key in found).values()) == 1
    for key in found:
        assert check_key(key) == key
        assert len(key) <= limit


def test_long_variant_names_shorten_keys(meshes, define) -> None:
    variant = {"name": "v" * 40, "views": 2, "sigma": 0.0, "encodings": ["tdf_occupancy"]}
    plan = make_plan(define(inputs=[variant]), meshes(["m" * 80]))
    assert len(tar_name(plan.items[0].key, f"{'v' * 40}-tdf_occupancy-64.oct")) == MAX_NAME
    with pytest.raises(OcnfError, match="name is too long"):
        make_plan(define(inputs=[{**variant, "name": "v" * 70}]), meshes(["m"]))


def test_shards_mix_categories_and_hold_everything_once(meshes, define) -> None:
    root = meshes([f"c{i}" for i in range(20)])
    meshes([f"t{i}" for i in range(20)], "table")
    source = {"kind": "modelnet", "categories": ["chair", "table"], "counts": {"train": 15, "val": 5}}
    plan = make_plan(define(source=source, shards={"samples": 8}), root)
    assert [(shard.split, shard.number, len(shard.items)) for shard in plan.shards] == [
        ("train", 0, 8), ("train", 1, 8), ("train", 2, 8), ("train", 3, 6), ("val", 0, 8), ("val", 1, 2)]
    assert all(len({item.category for item in shard.items}) == 2 for shard in plan.shards[:5])
    assert len({item.source for item in plan.items}) == 40
    other = make_plan(define(source=source, shards={"samples": 8}, seed=1), root)
    assert [item.key for item in plan.items] != [item.key for item in other.items]
    assert {item.key for item in plan.items} == {item.key for item in other.items}


def test_more_meshes_leave_keys_and_relative_order_alone(meshes, define) -> None:
    root = meshes([f"a{i}" for i in range(10)])
    before = [item.key for item in make_plan(define(), root).items]
    meshes([f"b{i}" for i in range(10)])
    after = [item.key for item in make_plan(define(), root).items if "-a" in item.key]
    assert after == before


TEXT = st.text(st.characters(exclude_categories=()), max_size=6)  # file names that are no Unicode too
ITEMS = st.builds(Item, TEXT, st.just("train"), TEXT, TEXT, st.none() | st.just("0f" * 32),
                  st.none() | st.integers(0, 2**40))
LISTS = st.lists(st.lists(ITEMS, min_size=1, max_size=3).map(tuple), max_size=3)


@given(LISTS, LISTS)
def test_the_pieces_of_a_plan_are_canonical_json(train, test) -> None:
    shards = [ShardPlan(split, number, items) for split, lists in (("train", train), ("test", test))
              for number, items in enumerate(lists)]
    failure = Failure("a", "train", "chair", "a.off", "plan", "excluded", "is the same file")
    plan = Plan({"name": "tiny", "shards": {"samples": 3}}, {"cpu": "any"}, tuple(shards), (failure,))
    expected = canonical_json({
        "schema": 1, "manifest": plan.manifest, "fingerprint": plan.fingerprint,
        "exclusions": [failure.to_json()],
        "shards": {split: [[item.to_json() for item in items] for items in lists]
                   for split, lists in (("train", train), ("test", test)) if lists}}, indent=1)
    assert plan.to_json() == expected


def test_a_plan_survives_its_file(meshes, define) -> None:
    import json

    root = meshes(["a", "b"])
    (root / "chair/train/z.off").symlink_to(root / "chair/train/a.off")
    plan = make_plan(define(), root)
    assert len(plan.exclusions) == 1
    assert Plan.from_dict(json.loads(plan.to_json())) == plan


@pytest.mark.parametrize(("splits", "message"), [
    (["tran"], "splits: no split of a manifest; found tran, expected train, val, test"),
    (["train", ""], "no split of a manifest"),
    ("train", r"not a list of splits; found train, expected \['train'\]"),
    (["val", "test"], "no item in the splits that are asked for; found val, test, expected train"),
    ([], "no item in the splits that are asked for; found none, expected train")])
def test_a_split_that_is_none_makes_no_data_set(meshes, define, tmp_path, splits, message) -> None:
    """Without a mesh, a set would be finished at once, and empty."""
    with pytest.raises(OcnfError, match=message):
        generate(define(), tmp_path / "out", meshes(["a"]), splits=splits, progress=False)
    assert not list((tmp_path / "out").rglob("*.json"))
