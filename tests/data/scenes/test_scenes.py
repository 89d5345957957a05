"""Scenes are what they say: things that stand on something and keep apart, the same for the same name."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import combinations

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.generation.records import Item
from ocnf_data.generation.remake import remake
from ocnf_data.generation.sample import make_sample, render_item
from ocnf_data.manifest import Manifest
from ocnf_data.meshes import normalise
from ocnf_data.octree import decode
from ocnf_data.render import render_depth
from ocnf_data.scenes import SCENES, draft_scene, make_scene
from ocnf_data.views.cameras import Views


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("index", range(8))
def test_things_keep_apart_and_stand_on_something(kind: str, index: int) -> None:
    things = [(part, name) for part, name in draft_scene(kind, 0, index, "train").parts if name != "shell"]
    shell = [part for part, name in draft_scene(kind, 0, index, "train").parts if name == "shell"]
    assert len(things) >= 2
    low, high = (np.array([end(part.vertices, axis=0) for part, _ in things]) for end in (np.min, np.max))
    for i, j in combinations(range(len(things)), 2):
        assert ((low[i] > high[j] - 1e-6) | (low[j] > high[i] - 1e-6)).any(), (things[i][1], things[j][1])
    for i, (_, name) in enumerate(things):
        carried = [k for k in range(len(things)) if abs(high[k][2] - low[i][2]) < 1e-6
                   and (low[k] < high[i])[:2].all() and (high[k] > low[i])[:2].all()]
        assert name == "picture" or abs(low[i][2]) < 1e-6 or carried, name
    floor = shell[0].vertices  # everything is above it, and within the walls if there are any
    assert (low >= floor.min(axis=0) - 1e-6)[:, :2].all() and (high <= floor.max(axis=0) + 1e-6)[:, :2].all()
    for wall in shell[1:]:
        a, b = wall.vertices.min(axis=0), wall.vertices.max(axis=0)
        assert ((low >= b - 1e-6) | (high <= a + 1e-6)).any(axis=1).all()


@pytest.mark.parametrize("kind", SCENES)
def test_a_scene_is_a_function_of_its_name(kind: str) -> None:
    code = f"from ocnf_data.scenes import make_scene; print(make_scene({kind!r}, 3, 5, 'val').sha256)"
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout
    assert there.strip() == make_scene(kind, 3, 5, "val").sha256
    others = {make_scene(kind, *rest).sha256 for rest in ((3, 6, "val"), (4, 5, "val"), (3, 5, "train"))}
    assert len({there.strip(), *others}) == 4


def test_kinds_that_there_are_not() -> None:
    with pytest.raises(OcnfError, match="no such kind of scene; found gardens"):
        make_scene("gardens", 0, 0, "train")


def scenes(kind: str, rig: str, **more: object) -> Manifest:
    return Manifest.from_dict({
        "name": "s", "source": {"kind": "scenes", "categories": [kind], "counts": {"train": 2}},
        "camera": {"rig": rig, "width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5},
        "resolutions": [64], "inputs": [{"name": "a", "views": 4, "noise": "kinect", "encodings": ["tsdf"]}],
        **more})


def centres(views: Views) -> np.ndarray:
    return -np.einsum("vji,vj->vi", views.R, views.T)


@pytest.mark.parametrize("index", range(3))
def test_cameras_in_a_room_are_in_it_and_clear_of_it(index: int) -> None:
    manifest, mesh = scenes("rooms", "inside20"), make_scene("rooms", 0, index, "train")
    vertices, _ = normalise(mesh, 3.0, 0.05)
    views = render_item(manifest, vertices, mesh, key="k")
    assert len(views) == manifest.camera.n_views == 20
    box = np.ptp(vertices, axis=0) / 2
    assert (np.abs(centres(views)) < box * 0.77).all()
    assert views.depth.min() > 0.04 * 3 * 0.6
    assert np.isfinite(views.depth).mean() > 0.6  # the rest is the door, and above the walls
    down = np.tile([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], (20, 1, 1))  # nothing but the floor is far below
    below = render_depth(vertices, mesh.faces, manifest.camera.K, down, -np.einsum(
        "vij,vj->vi", down, centres(views)), (48, 64))
    assert np.isfinite(below).all()
    again, other = (render_item(manifest, vertices, mesh, key=key) for key in ("k", "l"))
    np.testing.assert_array_equal(again.depth, views.depth)
    assert not np.array_equal(other.T, views.T)


def test_a_tabletop_is_seen_from_all_around() -> None:
    manifest, mesh = scenes("tabletops", "around12"), make_scene("tabletops", 0, 1, "train")
    vertices, _ = normalise(mesh, 3.0, 0.05)
    views = render_item(manifest, vertices, mesh, key="k")
    assert (centres(views)[:, 2] > 0.2).all() and (np.isfinite(views.depth).mean(axis=(1, 2)) > 0.1).all()


@pytest.mark.parametrize(("kind", "rig"), [("rooms", "inside12"), ("tabletops", "around12"),
                                           ("tabletops", "icosphere1")])
def test_a_sample_of_a_scene(kind: str, rig: str) -> None:
    manifest = scenes(kind, rig, camera={"rig": rig, "width": 64, "height": 48, "fx": 50, "fy": 50,
                                         "cx": 31.5, "cy": 23.5})
    item = Item(f"{kind}-train-0001", "train", kind, f"scenes:{kind}:train:1",
                make_scene(kind, 0, 1, "train").sha256, 1)
    sample = make_sample(manifest, item)
    truth = decode(sample.members["target-64.oct"]).to_dense()[0]
    assert 0.01 < (np.abs(truth) < 1).mean() < 0.6
    facts = json.loads(sample.members["json"])
    origin = remake(manifest, facts)
    assert facts["source"] == f"scenes:{kind}:train:1" and facts["camera"]["rig"] == rig
    assert origin.mesh.sha256 == item.sha256 and len(origin.views) == manifest.camera.n_views
