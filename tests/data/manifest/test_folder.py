"""A folder of meshes: which are taken, what they are called, that no share that was asked for stays empty."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocnf_data import OcnfError, generate
from ocnf_data.manifest import Manifest
from ocnf_data.manifest.folder import FolderSource
from ocnf_data.shards.dataset import load_dataset

CUBE = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
SHARES = {"train": 0.8, "val": 0.1, "test": 0.1}


def manifest(**source: object) -> Manifest:
    return Manifest.from_dict({
        "name": "own", "source": {"kind": "folder", **source},
        "camera": {"rig": "icosphere0", "width": 32, "height": 24, "fx": 17, "fy": 17, "cx": 16, "cy": 12},
        "resolutions": [16], "inputs": [{"name": "v1", "views": 1, "encodings": ["tsdf"]}]})


def place(root: Path, *paths: str) -> Path:
    for path in paths:
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(CUBE)
    return root


@given(n=st.integers(1, 40), seed=st.integers(0, 1000),
       shares=st.sampled_from([SHARES, {"train": 0.5, "test": 0.5},
                               {"train": 0.98, "val": 0.01, "test": 0.01}]))
def test_every_share_that_is_asked_for_gets_one(tmp_path_factory: pytest.TempPathFactory, n: int, seed: int,
                                                shares: dict[str, float]) -> None:
    """And chance alone decides wherever it leaves none empty."""
    root = tmp_path_factory.mktemp("meshes")
    place(root, *(f"{i}.off" for i in range(n)))
    source = FolderSource(kind="folder", shares=shares)
    filled = {e.path: e.split for e in source.entries(root, seed)}
    drawn = {e.path: e.split for e in source.by_chance_alone().entries(root, seed)}
    assert set(filled.values()) <= shares.keys() and filled.keys() == drawn.keys()
    assert len(set(filled.values())) == min(len(shares), n) or n < len(shares)
    missing = shares.keys() - set(drawn.values())
    moved = {path for path in filled if filled[path] != drawn[path]}
    assert len(moved) <= len(missing) and bool(moved) == bool(missing and n > len(set(drawn.values())))
    assert filled == {e.path: e.split for e in source.entries(root, seed)}


def test_the_patterns_choose_and_a_part_of_the_path_names_the_category(tmp_path: Path) -> None:
    """Laid out as ShapeNet is: category, model, `models`, file."""
    root = place(tmp_path, "02691156/a1/models/model_normalized.off", "02691156/a1/models/raw.off",
                 "03001627/b2/models/model_normalized.off", "03001627/bad/models/model_normalized.off",
                 "top.off")
    source = FolderSource(kind="folder", include=("*/model_normalized.off", "top.off"), exclude=("*/bad/*",))
    assert {(e.category, e.path) for e in source.entries(root)} == {
        ("02691156", "02691156/a1/models/model_normalized.off"),
        ("03001627", "03001627/b2/models/model_normalized.off"), ("mesh", "top.off")}
    for part, expected in ((1, {"a1", "b2", "mesh"}), (-2, {"a1", "b2", "mesh"}), (-1, {"models", "mesh"}),
                           (3, {"mesh"})):
        chosen = source.model_copy(update={"category_part": part})
        assert {e.category for e in chosen.entries(root)} == expected
    with pytest.raises(OcnfError, match="5 meshes, none of which the patterns take"):
        FolderSource(kind="folder", include=("*.stl",)).entries(root)


def test_a_manifest_without_the_later_fields_is_written_as_it_was() -> None:
    assert manifest().to_dict()["source"] == {
        "kind": "folder", "root": None, "at_most": None, "shares": SHARES}
    chosen = {"include": ["a*"], "exclude": ["b*"], "category_part": -1}
    assert manifest(**chosen).to_dict()["source"].items() >= chosen.items()
    assert Manifest.from_dict(manifest(**chosen).to_dict()) == manifest(**chosen)


def test_a_set_begun_with_an_empty_split_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It was made by chance alone, and `repair` and `generate` follow its plan; a new one has every split."""
    own = manifest(shares=SHARES)
    root = place(tmp_path / "meshes", *(f"{i}.off" for i in range(4)))
    drawn = Counter(e.split for e in own.by_chance_alone().source.entries(root))
    assert set(drawn) < set(SHARES), "the seed was chosen so"
    generate(own.by_chance_alone(), tmp_path / "old", root, progress=False)
    assert "no mesh is left for" not in capsys.readouterr().err
    before = {path: path.read_bytes() for path in (tmp_path / "old").rglob("*") if path.is_file()}
    report = generate(own, tmp_path / "old", root)
    assert report.made == 0 and "no mesh is left for" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in (tmp_path / "old").rglob("*") if path.is_file()} == before
    generate(own, tmp_path / "new", root)
    assert set(load_dataset(tmp_path / "new").splits) == set(SHARES)
    assert "note:" not in capsys.readouterr().err
    plans = [json.loads((tmp_path / name / "plan.json").read_bytes()) for name in ("old", "new")]
    assert plans[0]["manifest"] == plans[1]["manifest"]


def test_one_split_of_a_set_made_by_chance_alone_goes_on(tmp_path: Path) -> None:
    own = manifest(shares=SHARES)
    root = place(tmp_path / "meshes", *(f"{i}.off" for i in range(4)))
    drawn, now = (Counter(e.split for e in one.source.entries(root)) for one in (own.by_chance_alone(), own))
    split = next(split for split in drawn if drawn[split] != now[split])
    generate(own.by_chance_alone(), tmp_path / "old", root, splits=[split], progress=False)
    assert generate(own, tmp_path / "old", root, splits=[split], progress=False).made == 0


def test_what_training_needs_is_said_before_anything_is_made(tmp_path: Path,
                                                             capsys: pytest.CaptureFixture[str]) -> None:
    root = place(tmp_path / "meshes", "a.off", "b.off")
    generate(manifest(shares={"train": 1.0}), tmp_path / "out", root)
    assert "there is no split val" in " ".join(capsys.readouterr().err.split())
    generate(manifest(shares=SHARES), tmp_path / "few", root)
    assert "no mesh is left for" in " ".join(capsys.readouterr().err.split())
