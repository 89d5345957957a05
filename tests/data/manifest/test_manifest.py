"""A manifest is read as it was meant, or refused with the field, the value and what is allowed."""

from __future__ import annotations

import copy
import hashlib
import json
import pickle
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.manifest import SPLITS, Entry, Manifest, load_manifest, manifest_difference
from ocnf_data.manifest.schema import ABSENT
from ocnf_data.views.rigs import view_subset

MANIFESTS = Path(__file__).parents[3] / "manifests"
PUBLISHED = ["airplane", "bed", "car", "desk", "chair", "guitar", "piano", "person", "toilet"]

SHAPES = {"kind": "shapes", "categories": ["chair", "table", "lamp"],
          "counts": {"train": 16, "val": 4, "test": 8}}
MODELNET = {"kind": "modelnet", "categories": ["bed", "car"], "counts": {"train": 200, "val": 5, "test": 20}}
LIST = {"kind": "list", "items": {"train": ["a.obj", {"path": "b.off", "category": "bed", "key": "bed_1"}],
                                  "test": ["sub/c.ply"]}}
FOLDER = {"kind": "folder", "shares": {"train": 0.7, "val": 0.2, "test": 0.1}}


def example(**changes: Any) -> dict[str, Any]:
    """The design's example, with other fields."""
    return copy.deepcopy({
        "name": "demo", "seed": 0, "source": SHAPES,
        "normalise": {"extent": 3.0, "padding": 0.05},
        "camera": {"rig": "published80", "width": 640, "height": 480, "fx": 351, "fy": 351, "cx": 320,
                   "cy": 240, "distance": 3.0},
        "resolutions": [64, 128, 256], "truncation_voxels": 2.1333, "target": "tsdf",
        "inputs": [{"name": "v4_n02", "views": 4, "sigma": 0.02, "encodings": ["histogram"]}],
        "shards": {"samples": 16}, "views": "drop", **changes})


def refusal(data: dict[str, Any]) -> str:
    with pytest.raises(OcnfError) as caught:
        Manifest.from_dict(data, "demo.yaml")
    assert caught.value.where == "demo.yaml"
    return str(caught.value)


# ---- what is read


def test_the_designs_example() -> None:
    m = Manifest.from_dict(example())
    assert m.resolutions == (64, 128, 256)
    assert m.inputs[0].encodings == (Encoding.HISTOGRAM,)
    assert m.view_indices(m.inputs[0]) == (0, 26, 52, 79)
    assert m.camera.n_views == 80 and m.camera.size == (480, 640)
    np.testing.assert_array_equal(m.camera.K, [[351, 0, 320], [0, 351, 240], [0, 0, 1]])
    assert m.truncation(256) == pytest.approx(2.1333 * 3 / 256)


def test_the_defaults_are_the_papers() -> None:
    m = Manifest.from_dict({"name": "x", "source": SHAPES, "inputs": example()["inputs"]})
    assert [m.truncation(r) for r in (64, 128, 256)] == pytest.approx([0.1, 0.05, 0.025], rel=1e-15)
    assert manifest_difference(m, Manifest.from_dict(example(name="x", truncation_voxels=32 / 15))) == []
    assert m.limits.timeout_s == 300 and m.renderer == "raster"


@pytest.mark.parametrize("name", sorted(path.name for path in MANIFESTS.glob("*.yaml")))
def test_what_ships_loads(name: str) -> None:
    m = load_manifest(MANIFESTS / name)
    assert m.name == Path(name).stem
    assert m.resolutions == ((64, 128) if name == "demo-train.yaml" else (64, 128, 256))
    assert m.truncation(256) == pytest.approx(0.025, rel=1e-15)


def test_the_papers_experiments() -> None:
    experiments = ("encodings", "views", "noise", "unseen")
    papers = {e: load_manifest(MANIFESTS / f"paper-{e}.yaml") for e in experiments}
    inputs = {e: [(v.views, v.sigma) for v in m.inputs] for e, m in papers.items()}
    assert inputs == {"encodings": [(4, 0.02)], "views": [(n, 0.02) for n in (1, 2, 4, 6)],
                      "noise": [(4, s) for s in (0, 0.01, 0.02, 0.03)], "unseen": [(4, 0.02)]}
    assert set(papers["encodings"].inputs[0].encodings) == set(Encoding)
    for e, m in papers.items():
        seen = [c for c in PUBLISHED if e != "unseen" or c not in ("airplane", "desk")]
        tested = ["airplane", "desk"] if e == "unseen" else PUBLISHED
        assert (list(m.source.categories.train), list(m.source.categories.val)) == (seen, seen)
        assert list(m.source.categories.test) == tested
        chosen = {split: getattr(m.source.counts, split) for split in SPLITS}
        assert {split: (c.folder, c.skip, c.count) for split, c in chosen.items()} == {
            "train": ("train", 0, 200), "val": ("train", 200, 5), "test": ("test", 0, 20)}
        assert "tenth is unknown" in (MANIFESTS / f"paper-{e}.yaml").read_text()


@pytest.mark.parametrize("source", [SHAPES, MODELNET, LIST, FOLDER], ids=lambda s: s["kind"])
def test_round_trips(source: dict[str, Any], tmp_path: Path) -> None:
    m = Manifest.from_dict(example(source=source))
    assert Manifest.from_dict(m.to_dict()) == m
    assert Manifest.from_dict(json.loads(m.canonical_json())).canonical_json() == m.canonical_json()
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(m.to_dict()))
    loaded = load_manifest(tmp_path / "m.yaml")
    assert loaded == m and hash(loaded) == hash(m)
    again = pickle.loads(pickle.dumps(loaded))
    assert again == m
    if source["kind"] == "list":
        assert again.meshes_root() == tmp_path


def test_a_principal_point_off_the_centre() -> None:
    for cx, cy in ((0, 0), (-0.5, 479.5), (600, 3)):
        camera = Manifest.from_dict(example(camera={"cx": cx, "cy": cy})).camera
        assert (camera.K[0, 2], camera.K[1, 2]) == (cx, cy)


def test_it_is_immutable() -> None:
    m = Manifest.from_dict(example())
    with pytest.raises(ValidationError):
        m.seed = 1  # type: ignore[misc]
    with pytest.raises(ValidationError):
        m.camera.fx = 1.0  # type: ignore[misc]


def test_numbers_as_people_write_them(tmp_path: Path) -> None:
    """PyYAML alone reads 2e-2 as a string."""
    path = tmp_path / "m.yaml"
    path.write_text(yaml.safe_dump(example()).replace("0.02", "2e-2").replace("351", "3.51E+2"))
    m = load_manifest(path)
    assert m.inputs[0].sigma == 0.02 and m.camera.fx == 351


# ---- what is refused: the changes, and what the message must hold


REFUSED: list[tuple[str, dict[str, Any], list[str]]] = [
    ("unknown field", {"colour": 1}, ["colour: unknown field", "one of schema, name, seed"]),
    ("near miss", {"resolution": [64]}, ["resolution: unknown field", "Perhaps you mean resolutions"]),
    ("near miss below", {"camera": {"widht": 640}}, ["camera.widht: unknown", "Perhaps you mean width"]),
    ("near miss in a list", {"inputs": [{"name": "a", "views": 4, "sgima": 0.1, "encodings": ["tsdf"]}]},
     ["inputs[0].sgima: unknown field", "Perhaps you mean sigma"]),
    ("near miss in a source", {"source": {**SHAPES, "count": {}}},
     ["source.count: unknown field", "one of kind, categories, counts", "Perhaps you mean counts"]),
    ("negative noise", {"inputs": [{"name": "a", "views": 4, "sigma": -1, "encodings": ["tsdf"]}]},
     ["inputs[0].sigma", "found -1", "greater than or equal to 0"]),
    ("noise as text", {"inputs": [{"name": "a", "views": 4, "sigma": "2%", "encodings": ["tsdf"]}]},
     ["inputs[0].sigma", "found '2%'", "number"]),
    ("unknown scene", {"source": {"kind": "scenes", "categories": ["gardens"], "counts": {"train": 1}}},
     ["source.categories.train[0]", "found 'gardens'", "rooms, tabletops"]),
    ("no scenes", {"source": {"kind": "scenes", "categories": "all", "counts": {}}}, ["would be empty"]),
    ("a path without views", {"camera": {"rig": "inside0"}}, ["camera.rig", "found 'inside0'", "1 to 2000"]),
    ("unknown noise", {"inputs": [{"name": "a", "views": 4, "noise": "kinekt", "encodings": ["tsdf"]}]},
     ["inputs[0].noise", "found 'kinekt'", "'park' or 'kinect'"]),
    ("sigma of a sensor", {"inputs": [
        {"name": "a", "views": 4, "noise": "kinect", "sigma": 0.1, "encodings": ["tsdf"]}]},
     ["inputs[0].sigma", "belongs to the noise park", "found 0.1"]),
    ("strength without a sensor", {"inputs": [
        {"name": "a", "views": 4, "strength": 2.0, "encodings": ["tsdf"]}]},
     ["inputs[0].strength", "belongs to the noise kinect", "found 2.0"]),
    ("infinite", {"camera": {"fx": float("inf")}}, ["camera.fx", "found inf", "finite"]),
    ("truth for a number", {"inputs": [{"name": "a", "views": True, "encodings": ["tsdf"]}]},
     ["inputs[0].views", "found True", "integer"]),
    ("a fraction of a view", {"inputs": [{"name": "a", "views": 1.5, "encodings": ["tsdf"]}]},
     ["inputs[0].views", "found 1.5", "integer"]),
    ("no view", {"inputs": [{"name": "a", "views": 0, "encodings": ["tsdf"]}]},
     ["inputs[0].views", "found 0"]),
    ("more views than the rig has", {"inputs": [{"name": "a", "views": 81, "encodings": ["tsdf"]}]},
     ["inputs[0].views", "found 81", "1 to 80"]),
    ("unknown encoding", {"inputs": [{"name": "a", "views": 4, "encodings": ["tsdf", "hist"]}]},
     ["inputs[0].encodings[1]", "found 'hist'", "'occupancy', 'tsdf', 'tdf_occupancy' or 'histogram'"]),
    ("encoding twice", {"inputs": [{"name": "a", "views": 4, "encodings": ["tsdf", "tsdf"]}]},
     ["inputs[0].encodings[1]", "listed twice"]),
    ("no encoding", {"inputs": [{"name": "a", "views": 4, "encodings": []}]},
     ["inputs[0].encodings", "the list is empty", "at least one"]),
    ("no input", {"inputs": []}, ["inputs: the list is empty"]),
    ("input name taken", {"inputs": [{"name": "target", "views": 4, "encodings": ["tsdf"]}]},
     ["inputs[0].name", "found 'target'"]),
    ("input name with a dot", {"inputs": [{"name": "v4.n02", "views": 4, "encodings": ["tsdf"]}]},
     ["inputs[0].name", "found 'v4.n02'", "letters, digits and _"]),
    ("input name twice", {"inputs": [{"name": "a", "views": v, "encodings": ["tsdf"]} for v in (1, 2)]},
     ["inputs[1].name", "listed twice", "found 'a'"]),
    ("resolution", {"resolutions": [64, 100]}, ["resolutions[1]", "found 100", "multiple of 8"]),
    ("resolution too high", {"resolutions": [2048]}, ["resolutions[0]", "found 2048", "1024"]),
    ("resolution twice", {"resolutions": [64, 64]}, ["resolutions[1]", "not ascending", "found 64"]),
    ("resolutions descending", {"resolutions": [128, 64]}, ["resolutions[1]", "not ascending"]),
    ("one resolution, no list", {"resolutions": 64}, ["resolutions", "found 64", "a list"]),
    ("truncation", {"truncation_voxels": 0}, ["truncation_voxels", "found 0", "greater than 0"]),
    ("target", {"target": "sdf"}, ["target", "found 'sdf'", "'tsdf' or 'occupancy'"]),
    ("rig", {"camera": {"rig": "icosphere"}}, ["camera.rig", "found 'icosphere'", "published80"]),
    ("rig too large", {"camera": {"rig": "icosphere9"}}, ["camera.rig", "found 'icosphere9'", "0 to 5"]),
    ("inside the mesh", {"camera": {"distance": 2}}, ["camera.distance", "found 2", "more than 2.468"]),
    ("principal point left of the image", {"camera": {"cx": -1}},
     ["camera.cx", "outside of the image", "found -1", "-0.5 to 639.5"]),
    ("principal point beneath it", {"camera": {"cy": 480}},
     ["camera.cy", "outside of the image", "found 480", "-0.5 to 479.5"]),
    ("principal point of a larger image", {"camera": {"width": 300, "height": 480}},
     ["camera.cx", "found 320", "-0.5 to 299.5"]),
    ("padding", {"normalise": {"padding": 1}}, ["normalise.padding", "found 1", "less than 1"]),
    ("views", {"views": "keeps"}, ["views", "found 'keeps'", "'drop' or 'keep'"]),
    ("seed", {"seed": -1}, ["seed", "found -1"]),
    ("name", {"name": "a/b"}, ["name", "found 'a/b'"]),
    ("a later format", {"schema": 2}, ["schema", "found 2", "expected 1"]),
    ("format true", {"schema": True}, ["schema", "found True"]),
    ("no source", {"source": None}, ["source", "found None"]),
    ("kind", {"source": {"kind": "shape"}},
     ["source.kind", "found 'shape'", "'shapes', 'modelnet', 'folder', 'list'"]),
    ("no kind", {"source": {"categories": []}}, ["source.kind: the field is missing"]),
    ("unknown shape", {"source": {**SHAPES, "categories": ["chair", "chiar"]}},
     ["source.categories", "[1]", "found 'chiar'", "chair, "]),
    ("category twice", {"source": {**MODELNET, "categories": ["piano", "bed", "piano"]}},
     ["source.categories[2]", "listed twice", "found 'piano'"]),
    ("category twice in a split", {"source": {**MODELNET, "categories": {"train": ["bed", "bed"]}}},
     ["source.categories.train[1]", "listed twice"]),
    ("category outside", {"source": {**MODELNET, "categories": ["../bed"]}},
     ["source.categories[0]", "found '../bed'"]),
    ("one category, no list", {"source": {**MODELNET, "categories": "bed"}},
     ["source.categories", "found 'bed'", "a list of names, or all"]),
    ("unknown split", {"source": {**MODELNET, "categories": {"trian": ["bed"]}}},
     ["source.categories.trian"]),
    ("unknown split to count", {"source": {**SHAPES, "counts": {"trian": 3}}},
     ["source.counts.trian: unknown field", "train, val, test"]),
    ("negative count", {"source": {**SHAPES, "counts": {"train": -3}}}, ["source.counts.train", "found -3"]),
    ("negative count of files", {"source": {**MODELNET, "counts": {"train": -3}}},
     ["source.counts.train", "found -3", ">= 0, or all"]),
    ("nothing", {"source": {**SHAPES, "counts": {"train": 0}}}, ["source.counts", "empty"]),
    ("no files", {"source": {**MODELNET, "counts": {}}}, ["source.counts", "empty"]),
    ("a split without categories", {"source": {**MODELNET, "categories": {"test": ["bed"]}}},
     ["source.categories.train", "no categories"]),
    ("shared files",
     {"source": {**MODELNET, "counts": {"train": 20, "val": {"folder": "train", "count": 3}}}},
     ["source.counts.val", "val and train would hold the same meshes"]),
    ("nothing left for val", {"source": {**MODELNET, "counts": {"train": "all", "val": 5}}},
     ["source.counts.val", "none left"]),
    ("folder outside", {"source": {**MODELNET, "counts": {"train": {"folder": "../x", "count": 3}}}},
     ["source.counts.train.folder", "found '../x'"]),
    ("shares", {"source": {"kind": "folder", "shares": {"train": 0.5}}}, ["source.shares", "found 0.5"]),
    ("path twice",
     {"source": {"kind": "list", "items": {"train": ["a.obj"], "test": ["b.obj", "x/../a.obj"]}}},
     ["source.items.test[1].path", "listed twice", "train[0]"]),
    ("key twice",
     {"source": {"kind": "list", "items": {"train": [{"path": p, "key": "k"} for p in ("a", "b")]}}},
     ["source.items.train[1].key", "listed twice"]),
    ("key", {"source": {"kind": "list", "items": {"train": [{"path": "a", "key": "chair.v2"}]}}},
     ["source.items.train[0].key", "found 'chair.v2'"]),
    *((f"category {name!r}", {"source": {"kind": "list", "items": {"val": [
        "a.off", {"path": "b.off", "category": name}]}}},
       ["demo.yaml: source.items.val[1].category: not a folder's name", f"found {name!r}"])
      for name in ("../../../evil", "a/b", "/", "a\\b", "..", ".", "a\0")),
    ("an empty list", {"source": {"kind": "list", "items": {}}}, ["source.items", "empty"]),
]


@pytest.mark.parametrize(("changes", "parts"), [pytest.param(*rest, id=name) for name, *rest in REFUSED])
def test_a_refusal_names_field_value_and_what_is_allowed(changes: dict[str, Any], parts: list[str]) -> None:
    message = refusal(example(**changes))
    for part in parts:
        assert part in message, message
    assert "fields are wrong" not in message, "one slip is one complaint"
    assert "pydantic" not in message and "Input should" not in message


def test_all_errors_come_at_once() -> None:
    message = refusal(example(seed=-1, camera={"fx": 0}, target="x"))
    assert message.startswith("demo.yaml: 3 fields are wrong:")
    assert all(f"\n  {field}: " in message for field in ("seed", "camera.fx", "target"))


@pytest.mark.parametrize("field", ["name", "source", "inputs"])
def test_a_missing_field_is_named(field: str) -> None:
    data = example()
    del data[field]
    assert f"{field}: the field is missing" in refusal(data)


@pytest.mark.parametrize(("text", "parts"), [
    ("name: a\nname: b\n", ["line 2, column 1", "'name' is given twice"]),
    ("camera: {fx: 1, fx: 2}\n", ["line 1", "'fx' is given twice"]),
    ("a: &x [1]\nb: *x\n", ["line 2", "aliases"]),
    ("name: [1\n", ["not valid YAML", "line 2"]),
    ("name: !!python/object/apply:os.system [echo]\n", ["not valid YAML", "determine a constructor"]),
    ("- a\n", ["not a mapping", "found ['a']"]),
    ("", ["not a mapping", "found None"]),
    ("{" * 100_000, ["nested too deeply"]),
    ("name: 2026-99-99\n", ["not valid YAML"]),
    ("seed: 010\n", ["line 1, column 7", "010 is one number to YAML 1.1 and another to YAML 1.2"]),
    ("seed: -0_7\n", ["leading zero"]),
    ("seed: 1:30\n", ["1:30 is one number"]),
    ("limits: {timeout_s: 1:30.5}\n", ["1:30.5 is one number"]),
])
def test_a_file_that_is_no_manifest(text: str, parts: list[str], tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text(text)
    with pytest.raises(OcnfError) as caught:
        load_manifest(path)
    for part in [str(path), *parts]:
        assert part in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match="no such file") as caught:
        load_manifest(tmp_path / "none.yaml")
    assert caught.value.code == "missing"
    with pytest.raises(OcnfError, match="is a folder"):
        load_manifest(tmp_path)
    (tmp_path / "bytes.yaml").write_bytes(b"name: \xff\xfe")
    with pytest.raises(OcnfError, match=r"bytes\.yaml: not UTF-8"):
        load_manifest(tmp_path / "bytes.yaml")


TEXT = st.text(max_size=5)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | TEXT | st.sampled_from(["all", "chair"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3), max_leaves=8)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_value_in_any_place_is_read_or_refused(data: st.DataObject) -> None:
    """Whatever is put wherever: a manifest that resolves to itself, or our error."""
    source = data.draw(st.sampled_from([SHAPES, MODELNET, LIST, FOLDER]))
    whole: Any = example(source=source)
    place = whole
    while True:
        key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
        if not place[key] or not isinstance(place[key], dict | list) or data.draw(st.booleans()):
            break
        place = place[key]
    place[key] = data.draw(JSON)
    try:
        m = Manifest.from_dict(whole)
    except OcnfError:
        return
    assert Manifest.from_dict(m.to_dict()) == m
    json.loads(m.canonical_json())


def test_scenes_are_dealt_to_their_kinds_and_seen_from_paths() -> None:
    source = {"kind": "scenes", "categories": "all", "counts": {"test": 3}}
    m = Manifest.from_dict({"name": "s", "source": source,
                            "camera": {"rig": "inside40", "distance": 1.0}, "inputs": example()["inputs"]})
    assert m.source.entries() == [Entry("test", "rooms", index=0), Entry("test", "tabletops", index=0),
                                  Entry("test", "rooms", index=1)]
    assert m.meshes_root() is None and m.camera.n_views == 40
    assert m.view_indices(m.inputs[0]) == (0, 13, 26, 39)
    assert Manifest.from_dict(m.to_dict()) == m


# ---- comparing


def test_a_manifest_without_a_sensor_is_written_as_before_there_was_one() -> None:
    """Data sets that were begun then are resumed now."""
    park, kinect = example()["inputs"][0], {"name": "k", "views": 4, "noise": "kinect", "strength": 0.5,
                                            "encodings": ["tsdf"]}
    written = Manifest.from_dict(example(inputs=[park, kinect])).to_dict()["inputs"]
    assert set(written[0]) == {"name", "views", "sigma", "encodings"}
    assert written[1] == {**kinect, "sigma": 0.0, "metres": 1.0}
    demo = load_manifest(MANIFESTS / "demo.yaml").canonical_json()
    assert hashlib.sha256(demo.encode()).hexdigest().startswith("2cbb19f075367b2a")


def test_differences_name_the_field_and_both_values() -> None:
    before = Manifest.from_dict(example())
    now = example(seed=1, resolutions=[64, 128])
    now["inputs"][0]["sigma"] = 0.03
    found = manifest_difference(before, Manifest.from_dict(now))
    assert set(found) == {("seed", 0, 1), ("inputs[0].sigma", 0.02, 0.03), ("resolutions[2]", 256, ABSENT)}
    assert "inputs[0].sigma: 0.02 before, 0.03 now" in map(str, found)
    assert "resolutions[2]: 256 before, absent now" in map(str, found)


def test_the_place_of_the_meshes_is_no_difference() -> None:
    a, b = (Manifest.from_dict(example(source={**MODELNET, "root": root})) for root in ("/a", "b"))
    assert manifest_difference(a, b) == []
    assert [d.field for d in manifest_difference(a, b, ignore=())] == ["source.root"]


LEAVES = [("seed", 7), ("name", "other"), ("camera.fx", 350.0), ("camera.rig", "icosphere1"),
          ("normalise.padding", 0.1), ("resolutions[0]", 32), ("truncation_voxels", 3.0),
          ("target", "occupancy"), ("inputs[0].views", 5), ("inputs[0].encodings[0]", "tsdf"),
          ("shards.samples", 4), ("views", "keep"), ("limits.timeout_s", 1.0), ("renderer", "pyrender"),
          ("source.counts.train", 15), ("source.categories.test[1]", "desk")]


@settings(max_examples=40, deadline=None)
@given(chosen=st.sets(st.sampled_from(LEAVES)))
def test_exactly_the_changed_fields_differ(chosen: set[tuple[str, Any]]) -> None:
    before = Manifest.from_dict(example()).to_dict()
    now = copy.deepcopy(before)
    for path, value in chosen:
        *parents, last = path.replace("]", "").replace("[", ".").split(".")
        place: Any = now
        for part in parents:
            place = place[int(part) if isinstance(place, list) else part]
        place[int(last) if isinstance(place, list) else last] = value
    found = manifest_difference(Manifest.from_dict(before), Manifest.from_dict(now))
    assert {(d.field, d.now) for d in found} == chosen


# ---- entries


def test_shapes_are_dealt_in_turn() -> None:
    entries = Manifest.from_dict(example()).source.entries()
    assert Counter(e.split for e in entries) == {"train": 16, "val": 4, "test": 8}
    train = [e for e in entries if e.split == "train"]
    first = (("chair", 0), ("table", 0), ("lamp", 0), ("chair", 1))
    assert train[:4] == [Entry("train", category, index=i) for category, i in first]
    assert len(set(entries)) == 28


def modelnet(root: Path, files: dict[str, int]) -> None:
    for folder, n in files.items():
        (root / folder).mkdir(parents=True)
        for i in range(n):
            (root / folder / f"{Path(folder).parent.name}_{i:04d}.off").write_text("OFF\n")


def test_the_published_selection(tmp_path: Path) -> None:
    modelnet(tmp_path, {"bed/train": 12, "bed/test": 4, "car/train": 6, "car/test": 1})
    (tmp_path / "bed/train/.hidden.off").write_text("")
    (tmp_path / "bed/train/notes.txt").write_text("")
    source = {**MODELNET, "counts": {"train": 8, "val": 3, "test": 2}}
    m = Manifest.from_dict(example(source=source))
    entries = m.source.entries(m.meshes_root(tmp_path))
    hidden = [e for e in entries if e.excluded]
    assert [(e.split, e.path) for e in hidden] == [("train", "bed/train/.hidden.off")], "once, for two splits"
    chosen = {(e.split, e.path) for e in entries if not e.excluded}
    assert chosen == {
        *(("train", f"bed/train/bed_{i:04d}.off") for i in range(8)),
        *(("val", f"bed/train/bed_{i:04d}.off") for i in (8, 9, 10)),
        *(("test", f"bed/test/bed_{i:04d}.off") for i in (0, 1)),
        *(("train", f"car/train/car_{i:04d}.off") for i in range(6)),
        ("test", "car/test/car_0000.off")}


def test_all_categories_of_a_folder(tmp_path: Path) -> None:
    modelnet(tmp_path, {"bed/test": 2, "car/test": 1, "sofa/train": 3, ".cache/test": 1})
    source = {"kind": "modelnet", "categories": "all", "counts": {"train": "all", "test": "all"}}
    entries = Manifest.from_dict(example(source=source)).source.entries(tmp_path)
    assert Counter((e.split, e.category) for e in entries) == {
        ("train", "sofa"): 3, ("test", "bed"): 2, ("test", "car"): 1}


def test_a_folder_without_categories_says_so(tmp_path: Path) -> None:
    source = {"kind": "modelnet", "categories": "all", "counts": {"test": "all"}}
    with pytest.raises(OcnfError, match="no category found"):
        Manifest.from_dict(example(source=source)).source.entries(tmp_path)
    with pytest.raises(OcnfError, match="no such file or folder"):
        Manifest.from_dict(example(source=source)).source.entries(tmp_path / "none")
    with pytest.raises(OcnfError, match="no mesh found"):
        Manifest.from_dict(example(source=FOLDER)).source.entries(tmp_path)


def test_adding_files_to_a_folder_moves_no_other(tmp_path: Path) -> None:
    modelnet(tmp_path, {"bed/x/y": 40, "car": 40, ".git": 3})
    (tmp_path / "alone.STL").write_text("")
    m = Manifest.from_dict(example(source=FOLDER))
    before = m.source.entries(tmp_path, m.seed)
    assert len(before) == 81 and {e.category for e in before} == {"bed", "car", "mesh"}
    assert {e.split for e in before} == set(SPLITS)
    modelnet(tmp_path, {"desk": 40})
    after = m.source.entries(tmp_path, m.seed)
    assert len(after) == 121 and set(before) < set(after)
    assert {e.path: e.split for e in m.source.entries(tmp_path, 1)} != {e.path: e.split for e in after}
    ten = Manifest.from_dict(example(source={**FOLDER, "at_most": 10}))
    few = ten.by_chance_alone().source.entries(tmp_path, m.seed)
    assert len(few) == 10 and set(few) < set(after)
    filled = ten.source.entries(tmp_path, m.seed)
    assert {e.path for e in filled} == {e.path for e in few} and {e.split for e in filled} == set(SPLITS)
    half = Manifest.from_dict(example(source={**FOLDER, "at_most": 60})).source.entries(tmp_path, m.seed)
    assert {e.split for e in half} == set(SPLITS), "what is taken says nothing about where it goes"


def test_a_list_gives_what_it_lists() -> None:
    assert Manifest.from_dict(example(source=LIST)).source.entries() == [
        Entry("train", "mesh", "a.obj"), Entry("train", "bed", "b.off", key="bed_1"),
        Entry("test", "mesh", "sub/c.ply")]


def test_where_the_meshes_are(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text(yaml.safe_dump(example(source={**MODELNET, "root": "meshes"})))
    m = load_manifest(path)
    assert m.meshes_root() == tmp_path / "meshes"
    assert m.meshes_root("/elsewhere") == Path("/elsewhere")
    assert Manifest.from_dict(example()).meshes_root() is None
    with pytest.raises(OcnfError, match="--meshes ROOT"):
        Manifest.from_dict(example(source=MODELNET)).meshes_root()


@given(n=st.integers(1, 80))
def test_view_indices_are_the_rigs(n: int) -> None:
    m = Manifest.from_dict(example(inputs=[{"name": "a", "views": n, "encodings": ["tsdf"]}]))
    assert list(m.view_indices(m.inputs[0])) == view_subset(80, n).tolist()


def test_reading_one_needs_core_dependencies_only() -> None:
    extras = ["torch", "trimesh", "scipy", "h5py", "OpenGL", "cv2", "joblib"]
    code = (f"import sys; sys.modules.update(dict.fromkeys({extras}))\n"
            "from ocnf_data import load_manifest\n"
            "load_manifest(sys.argv[1])")
    subprocess.run([sys.executable, "-c", code, str(MANIFESTS / "demo.yaml")], check=True)
