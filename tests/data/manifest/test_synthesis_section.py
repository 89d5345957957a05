"""The manifest's section for drawn samples, and sources that are mixtures of others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data import generate
from ocnf_data.errors import OcnfError
from ocnf_data.generation.plan import list_items, make_plan
from ocnf_data.manifest import Manifest, load_manifest
from ocnf_data.manifest.synthesis import Directions, Rotate, Synthesis
from ocnf_data.shards import load_dataset

SHAPES = {"kind": "shapes", "categories": ["mug", "bowl"], "counts": {"train": 3, "val": 2}}
FIELDS: dict[str, Any] = {
    "name": "m", "source": SHAPES, "resolutions": [16],
    "camera": {"rig": "fibonacci8", "width": 32, "height": 24, "fx": 18, "fy": 18, "cx": 16, "cy": 12},
    "inputs": [{"name": "v2", "views": 2, "encodings": ["tsdf"]}],
}


def with_section(**section: Any) -> Manifest:
    return Manifest.from_dict({**FIELDS, "synthesis": section})


def weights(names: type) -> st.SearchStrategy[Any]:
    one = st.sampled_from(list(map(str, names)))
    return one | st.dictionaries(one, st.floats(0.01, 100) | st.integers(1, 9), min_size=1)


@given(rotate=weights(Rotate), directions=weights(Directions), views=st.tuples(*[st.integers(1, 8)] * 2),
       sigma=st.tuples(*[st.floats(0, 1)] * 2), repeat=st.integers(1, 1000))
@settings(max_examples=50, deadline=None)
def test_what_is_read_is_written_and_read_again(rotate, directions, views, sigma, repeat) -> None:
    manifest = with_section(rotate=rotate, directions=directions, views=sorted(views), sigma=sorted(sigma),
                            repeat=repeat)
    again = Manifest.from_dict(manifest.to_dict())
    assert again == manifest
    assert again.synthesis == manifest.synthesis
    assert again.synthesis is not None
    assert set(again.synthesis.rotate) == ({rotate} if isinstance(rotate, str) else set(rotate))


def test_a_manifest_without_the_section_is_what_it_was_before_there_was_one() -> None:
    assert "synthesis" not in Manifest.from_dict(FIELDS).to_dict()
    assert Manifest.from_dict({**FIELDS, "synthesis": None}) == Manifest.from_dict(FIELDS)
    assert Manifest.from_dict(FIELDS) != with_section()
    assert with_section().synthesis == Synthesis()


def test_the_section_changes_nothing_of_a_generated_data_set(tmp_path: Path) -> None:
    generate(Manifest.from_dict(FIELDS), tmp_path / "a", progress=False)
    generate(with_section(rotate="any", views=[1, 8]), tmp_path / "b", progress=False)
    shards = [sorted((tmp_path / name).rglob("*.tar")) for name in "ab"]
    assert [path.read_bytes() for path in shards[0]] == [path.read_bytes() for path in shards[1]]


@pytest.mark.parametrize(("section", "message"), [
    ({"rotat": "any"}, r"synthesis\.rotat: unknown field.*perhaps you mean rotate"),
    ({"rotate": "up"}, r"synthesis\.rotate\.up.*'none', 'upright' or 'any'"),
    ({"rotate": {}}, r"synthesis\.rotate: the list is empty"),
    ({"rotate": ["any"]}, r"synthesis\.rotate: not a name, nor names with weights"),
    ({"directions": {"rig": 0}}, r"synthesis\.directions\.rig.*found 0.*greater than 0"),
    ({"views": [3, 2]}, r"synthesis\.views.*wrong way round"),
    ({"views": [0, 2]}, r"synthesis\.views\[0\]"),
    ({"views": [1, 9]}, r"synthesis\.views\[1\].*found 9, expected 1 to 8"),
    ({"views": [1, 2, 3]}, r"synthesis\.views"),
    ({"sigma": [0.0, 1.5]}, r"synthesis\.sigma\[1\]"),
    ({"scale": [0.5, 1.1]}, r"synthesis\.scale\[1\]"),
    ({"zoom": [0.5, 2]}, r"synthesis\.zoom\[0\].*found 0\.5"),
    ({"cameras": "sphere"}, r"synthesis\.cameras\.sphere.*'path' or 'single'"),
    ({"zoom": [1, 2]}, r"synthesis\.zoom: zoom belongs to scenes; found.*1\.0, 2\.0.*expected"),
    ({"cameras": "single"}, r"synthesis\.cameras: cameras belongs to scenes; found \{'single': 1\.0\}"),
    ({"samples_per_epoch": 0}, r"synthesis\.samples_per_epoch"),
    ({"up": "w"}, r"synthesis\.up.*'x', 'y' or 'z'"),
    ({"noise": "salt"}, r"synthesis\.noise\.salt.*'park' or 'kinect'"),
])
def test_what_is_wrong_is_named(section: dict[str, Any], message: str) -> None:
    with pytest.raises(OcnfError, match=f"(?i){message}"):
        with_section(**section)


@pytest.mark.parametrize(("idle", "used", "message"), [
    ({"metres": 0.5}, {"noise": {"park": 1, "kinect": 1}}, "metres.*found 0.5, expected 1.0, or kinect"),
    ({"strength": [0, 2]}, {"noise": "kinect"}, r"strength.*found \[0.0, 2.0\], expected.*or kinect"),
    ({"sigma": [0, 0.1], "noise": "kinect"}, {"noise": {"park": 1, "kinect": 1}}, "sigma.*or park"),
    ({"up": "y", "rotate": "any"}, {"rotate": {"any": 1, "upright": 2}}, "up.*found y.*or upright"),
], ids=str)
def test_what_would_have_no_effect_is_refused_in_a_file(idle, used, message, tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"

    def load(section: dict[str, Any]) -> Manifest:
        path.write_text(yaml.safe_dump({**FIELDS, "synthesis": section}))
        return load_manifest(path)

    with pytest.raises(OcnfError, match=rf"m\.yaml: synthesis\.{message}") as caught:
        load(idle)
    assert caught.value.code == "manifest"
    manifest = load({**idle, **used})
    path.write_text(yaml.safe_dump(manifest.to_dict()))  # with all defaults filled in
    assert load_manifest(path) == manifest
    with_section(**idle)  # as a data set of an earlier version has it: that can still be read


REPOSITORY = Path(__file__).parents[3]


@pytest.mark.parametrize("path", [
    *sorted((REPOSITORY / "manifests").glob("*.yaml")),
    *sorted((REPOSITORY / "ocnf_model/pretrained").rglob("*manifest*.yaml")),
], ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_those_that_come_along_are_valid(path: Path) -> None:
    load_manifest(path)


def test_what_belongs_to_scenes_needs_some() -> None:
    section = {"zoom": [1, 2], "cameras": "single"}
    scenes = {"kind": "scenes", "categories": "all", "counts": {"train": 1}}
    for source in (scenes, {"kind": "mixture", "parts": [{"source": SHAPES}, {"source": scenes}]}):
        manifest = Manifest.from_dict({**FIELDS, "source": source, "synthesis": section})
        assert Manifest.from_dict(manifest.to_dict()) == manifest
    with pytest.raises(OcnfError, match="belongs to scenes"):
        Manifest.from_dict({**FIELDS, "source": {"kind": "mixture", "parts": [{"source": SHAPES}]},
                            "synthesis": section})
    assert with_section(zoom=[1, 1], cameras={"single": 1, "path": 1}).synthesis == Synthesis()


# ---- several sources as one


def mixed(*parts: Any, **changes: Any) -> Manifest:
    return Manifest.from_dict({**FIELDS, "source": {"kind": "mixture", "parts": list(parts)}, **changes})


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    for name in ("chair/train/a.off", "chair/train/b.off", "chair/train/c.off"):
        path = tmp_path / "meshes" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        faces = "3 0 1 2\n3 0 1 3\n3 0 2 3\n3 1 2 3\n"
        path.write_text(f"OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n{faces}# {name}")
    return tmp_path / "meshes"


FILES = {"kind": "modelnet", "categories": "all",
         "counts": {"train": {"folder": "train", "skip": 1, "count": "all"},
                    "val": {"folder": "train", "count": 1}}}


def test_a_mixture_has_the_entries_of_its_parts(meshes: Path, tmp_path: Path) -> None:
    manifest = mixed({"weight": 2, "source": FILES}, {"source": SHAPES})
    entries = manifest.source.entries(meshes, 0)
    assert [(entry.split, entry.path, entry.index) for entry in entries if entry.category == "chair"] == [
        ("train", "chair/train/b.off", None), ("train", "chair/train/c.off", None),
        ("val", "chair/train/a.off", None)]
    assert sum(entry.path is None for entry in entries) == 5
    assert manifest.meshes_root(meshes) == meshes
    with pytest.raises(OcnfError, match="--meshes ROOT"):
        manifest.meshes_root()
    assert mixed({"source": SHAPES}).meshes_root(meshes) is None
    items = {item.key: item for item in make_plan(manifest, meshes).items}
    assert len(items) == 8
    assert [items[key].sha256 is None for key in ("chair-train-b", "mug-train-0000")] == [False, True]
    report = generate(manifest, tmp_path / "out", meshes, progress=False)
    assert report.ok
    assert load_dataset(str(tmp_path / "out")).counts.samples == 8


def test_the_same_file_in_two_parts_is_one_item(meshes: Path) -> None:
    again = {"kind": "list", "items": {"test": ["chair/train/a.off"]}}
    manifest = mixed({"source": FILES}, {"source": again})
    plan = make_plan(manifest, meshes)
    assert len(plan.items) == 3
    assert [row.split for row in plan.exclusions] == ["test"]


@pytest.mark.parametrize(("parts", "message"), [
    ([], r"source\.parts: the list is empty"),
    ([{"weight": 0, "source": SHAPES}], r"source\.parts\[0\]\.weight"),
    ([{"source": {"kind": "mixture", "parts": []}}], r"source\.parts\[0\]\.source\.kind.*'mixture'"),
    ([{"source": {"kind": "folder", "root": "there", "shares": {"train": 1.0}}}],
     r"source\.parts\[0\]\.source\.root.*'there'"),
    ([{"source": {**SHAPES, "categories": ["spoon"]}}], r"source\.parts\[0\]\.source\.categories.*'spoon'"),
])
def test_a_bad_mixture_is_refused(parts: list[Any], message: str) -> None:
    with pytest.raises(OcnfError, match=message):
        mixed(*parts)


# ---- some splits only


def test_some_splits_may_be_made_alone(meshes: Path, tmp_path: Path) -> None:
    manifest = mixed({"source": FILES}, {"source": SHAPES})
    generate(manifest, tmp_path / "all", meshes, progress=False)
    generate(manifest, tmp_path / "val", meshes, splits=["val"], progress=False)
    assert set(load_dataset(str(tmp_path / "val")).splits) == {"val"}
    whole, alone = (sorted((tmp_path / name / "val").glob("*.tar")) for name in ("all", "val"))
    assert [path.read_bytes() for path in whole] == [path.read_bytes() for path in alone]
    keys = [item.key for split in ("train", "val") for item in list_items(manifest, meshes, (split,))[0]]
    assert sorted(keys) == sorted(item.key for item in make_plan(manifest, meshes).items)
    with pytest.raises(OcnfError):
        generate(manifest, tmp_path / "val", meshes, progress=False)  # it was begun with fewer
