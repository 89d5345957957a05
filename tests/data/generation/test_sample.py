"""A sample is a pure function of (manifest, item), and holds what it says (promise 9, SEMANTICS 2)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.fusion import fuse_histogram, fuse_tsdf
from ocnf_data.generation import generate
from ocnf_data.generation.plan import make_plan
from ocnf_data.generation.records import Item, Sample
from ocnf_data.generation.remake import remake
from ocnf_data.generation.sample import make_sample, render_item
from ocnf_data.manifest import Manifest
from ocnf_data.meshes import normalise, read_mesh
from ocnf_data.octree import GridOctree, decode
from ocnf_data.octree.occupied import occupied
from ocnf_data.views.noise import add_noise, view_noise
from ocnf_data.views.sensor import add_sensor_noise, sensor_draws
from ocnf_data.views.store import ViewStore, read_kept

HISTOGRAM = {"name": "v3", "views": 3, "sigma": 0.03, "encodings": ["histogram"]}


def first(manifest: Manifest, root: Path) -> tuple[Item, Sample]:
    item = make_plan(manifest, root).items[0]
    return item, make_sample(manifest, item, root)


def test_members_are_what_the_definitions_give(meshes, define) -> None:
    manifest, root = define(inputs=[HISTOGRAM], resolutions=[64, 72]), meshes("a")
    item, sample = first(manifest, root)
    assert list(sample.members) == ["json", "target-64.oct", "target-72.oct", "v3-histogram-64.oct",
                                    "v3-histogram-72.oct"]
    mesh = read_mesh(root / item.source)
    views = render_item(manifest, normalise(mesh)[0], mesh)
    noisy = views.subset([0, 3, 7])
    noisy = noisy.with_depth(np.stack([add_noise(depth, 0.03, view_noise(0, item.key, view, (40, 48)))
                                       for view, depth in zip([0, 3, 7], noisy.depth, strict=True)]))
    for res in (64, 72):
        tau = 32 / 15 * 3 / res
        for name, octree in ((f"target-{res}.oct", fuse_tsdf(views, res, 3.0, tau)),
                             (f"v3-histogram-{res}.oct", fuse_histogram(noisy, res, 3.0, tau))):
            stored = decode(sample.members[name])
            assert np.array_equal(stored.trees, octree.trees)
            np.testing.assert_allclose(stored.data, octree.data, atol=1 / 255)
            assert json.loads(sample.members["json"])["leaf_counts"][name] == octree.n_leaves


def test_the_json_says_how_it_was_made(meshes, define) -> None:
    manifest, root = define(), meshes("a")
    item, sample = first(manifest, root)
    facts = json.loads(sample.members["json"])
    mesh = read_mesh(root / item.source)
    assert (facts["key"], facts["split"], facts["category"]) == ("chair-train-a", "train", "chair")
    assert facts["source"] == "chair/train/a.off"
    assert facts["mesh"] == {"sha256": mesh.sha256, **mesh.stats}
    assert facts["mesh"]["watertight"] is True
    assert facts["camera"]["K"] == [[28, 0, 24], [0, 27, 20], [0, 0, 1]]
    assert facts["camera"]["size"] == [40, 48]
    assert facts["inputs"] == {"v2": {"views": [0, 7], "sigma": 0.02}}
    assert facts["truncation"] == {"64": pytest.approx(0.1)}
    assert 0 < facts["coverage"] < 1
    centre, scale = np.array(facts["normalisation"]["centre"]), facts["normalisation"]["scale"]
    np.testing.assert_array_equal((mesh.vertices - centre) * scale, normalise(mesh)[0])


def test_noise_depends_on_seed_sample_and_view_only(meshes, define) -> None:
    root = meshes("abc")
    variant = {"name": "v2", "views": 2, "sigma": 0.02, "encodings": ["tsdf"]}
    item, sample = first(define(), root)
    name = "v2-tsdf-64.oct"
    busy = define(inputs=[HISTOGRAM, {**variant, "encodings": ["occupancy", "tsdf"]}], resolutions=[32, 64],
                  shards={"samples": 1})
    assert make_sample(busy, item, root).members[name] == sample.members[name]
    assert make_sample(define(seed=1), item, root).members[name] != sample.members[name]
    renamed = Item("other", item.split, item.category, item.source)
    assert make_sample(define(), renamed, root).members[name] != sample.members[name]


def test_a_sensor_in_place_of_parks_noise(meshes, define) -> None:
    root = meshes("ab")
    sensor = {"name": "k2", "views": 2, "noise": "kinect", "strength": 1.5, "metres": 0.5,
              "encodings": ["tsdf"]}
    park = {"name": "v2", "views": 2, "sigma": 0.02, "encodings": ["tsdf"]}
    manifest = define(inputs=[park, sensor])
    item, sample = first(manifest, root)
    _, alone = first(define(), root)
    assert sample.members["v2-tsdf-64.oct"] == alone.members["v2-tsdf-64.oct"]
    assert json.loads(sample.members["json"])["inputs"]["k2"] == {
        "views": [0, 7], "noise": "kinect", "strength": 1.5, "metres": 0.5}
    vertices, _ = normalise(read_mesh(root / item.source))
    views = render_item(manifest, vertices, read_mesh(root / item.source))
    depth = [add_sensor_noise(views.depth[i], views.K[i], sensor_draws(0, item.key, i, views.size), 1.5, 0.5)
             for i in (0, 7)]
    expected = fuse_tsdf(views.subset([0, 7]).with_depth(np.stack(depth)), 64, 3.0, manifest.truncation(64))
    stored = decode(sample.members["k2-tsdf-64.oct"])
    np.testing.assert_array_equal(stored.trees, expected.trees)
    np.testing.assert_allclose(stored.data, expected.data, atol=1 / 200)


def test_a_sensor_sees_a_scene_at_its_own_size(define) -> None:
    """A tabletop magnified into the cube has the noise of a tabletop; what `remake` makes is the same."""
    sensor = {"name": "k2", "views": 2, "noise": "kinect", "encodings": ["tsdf"]}
    manifest = define(inputs=[sensor], source={
        "kind": "scenes", "categories": {"train": ["tabletops"], "val": [], "test": ["rooms"]},
        "counts": {"train": 1, "val": 0, "test": 1}})
    scales = []
    for item in make_plan(manifest, None).items:
        sample = make_sample(manifest, item, None)
        facts = json.loads(sample.members["json"])
        scales.append(facts["normalisation"]["scale"])
        metres = facts["inputs"]["k2"]["metres"]
        assert metres == 1 / scales[-1]
        remade = remake(manifest, facts)
        depth = [add_sensor_noise(remade.views.depth[i], remade.views.K[i],
                                  sensor_draws(0, item.key, i, remade.views.size), 1.0, metres)
                 for i in (0, 7)]
        np.testing.assert_array_equal(remade.observed["k2"].depth, depth)
        expected = fuse_tsdf(remade.observed["k2"], 64, 3.0, manifest.truncation(64))
        stored = decode(sample.members["k2-tsdf-64.oct"])
        np.testing.assert_array_equal(stored.trees, expected.trees)
        facts["inputs"]["k2"]["metres"] = 1.0  # of a data set of before
        assert not np.array_equal(remake(manifest, facts).observed["k2"].depth, depth)
    assert min(scales) < 1 < max(scales)


def test_the_same_views_carry_the_same_noise_in_every_subset(meshes, define) -> None:
    """With sigma 0 the noise is gone, and the input is the clean fusion."""
    root = meshes("a")
    clean = {"name": "v8", "views": 8, "sigma": 0.0, "encodings": ["tsdf"]}
    _, sample = first(define(inputs=[clean]), root)
    truth, stored = decode(sample.members["target-64.oct"]), decode(sample.members["v8-tsdf-64.oct"])
    assert np.array_equal(truth.trees, stored.trees)


def test_an_occupancy_target_is_the_sign_of_the_tsdf(meshes, define) -> None:
    root = meshes("a")
    _, tsdf = first(define(), root)
    _, sample = first(define(target="occupancy"), root)
    values = decode(tsdf.members["target-64.oct"]).to_dense()
    expected = GridOctree.from_dense((values < 0).astype(np.float32))
    stored = decode(sample.members["target-64.oct"])
    assert np.array_equal(stored.trees, expected.trees)
    np.testing.assert_array_equal(stored.data, expected.data)
    assert 0 < stored.data.mean() < 1


def test_occupied_equals_the_dense_definition() -> None:
    rng = np.random.default_rng(0)
    coarse = rng.standard_normal((1, 8, 4, 6)).astype(np.float32)
    values = coarse.repeat(4, 1).repeat(4, 2).repeat(4, 3)
    values[:, :9, :5] += rng.standard_normal(values[:, :9, :5].shape).astype(np.float32)
    values[:, 16:] = -1
    octree = GridOctree.from_dense(values)
    expected = GridOctree.from_dense((octree.to_dense() < 0).astype(np.float32))
    found = occupied(octree)
    assert np.array_equal(found.trees, expected.trees)
    np.testing.assert_array_equal(found.data, expected.data)
    assert found.n_leaves < octree.n_leaves


@pytest.mark.parametrize("extent", [1e-6, 1e-3])
@pytest.mark.parametrize("rig", ["fibonacci8", "around3"])
def test_a_tiny_cube_is_seen_as_a_large_one(meshes, define, extent, rig) -> None:
    """No near plane cuts into meshes that lie within a millimetre of their cameras."""
    root = meshes("a")
    camera = define().to_dict()["camera"] | {"rig": rig}
    depth = []
    for size in (3.0, extent):
        manifest = define(normalise={"extent": size}, camera={**camera, "distance": size})
        mesh = read_mesh(root / "chair/train/a.off")
        depth.append(render_item(manifest, normalise(mesh, size)[0], mesh, key="a").depth / size)
    assert 0.1 < np.isfinite(depth[0]).mean() < 1
    off = ~np.isclose(*depth, rtol=1e-5)  # a pixel's centre may be on an edge
    assert off.sum() <= 2


def test_a_mesh_that_no_camera_sees(meshes, define, tmp_path) -> None:
    """A camera that looks past the mesh."""
    root = meshes("a")
    manifest = define()
    past = manifest.camera.model_copy(update={"cx": -9000.0})  # which no manifest of a file's may have
    item = make_plan(manifest, root).items[0]
    with pytest.raises(OcnfError) as caught:
        make_sample(manifest.model_copy(update={"camera": past}), item, root)
    assert caught.value.code == "invisible"


def test_a_mesh_that_changes_under_way(meshes, define) -> None:
    root = meshes("a")
    item = make_plan(define(), root).items[0]
    (root / item.source).write_text((root / item.source).read_text().replace("1 0 0", "1.5 0 0"))
    with pytest.raises(OcnfError) as caught:
        make_sample(define(), item, root)
    assert caught.value.code == "changed"


def test_procedural_shapes(tmp_path) -> None:
    manifest = Manifest.from_dict({
        "name": "shapes", "source": {"kind": "shapes", "categories": ["chair", "mug"], "counts": {"val": 3}},
        "camera": {"rig": "fibonacci8", "width": 48, "height": 40, "fx": 28, "fy": 28, "cx": 24, "cy": 20},
        "resolutions": [64], "inputs": [HISTOGRAM]})
    report = generate(manifest, tmp_path / "out", progress=False)
    assert (report.samples, report.failures) == (3, ())
    keys = [item.key for item in make_plan(manifest, None).items]
    assert sorted(keys) == ["chair-val-0000", "chair-val-0001", "mug-val-0000"]


def test_kept_views_replace_rendering(meshes, define, tmp_path, contents) -> None:
    """For another manifest with the same cameras; a rendering that fails shows that none happens."""
    root, out = meshes("ab"), tmp_path / "out"
    generate(define(views="keep"), out, root, progress=False)
    assert sorted(path.name for path in out.glob("views/*")) == ["chair-train-a.h5", "chair-train-b.h5"]
    kept = read_kept(str(out / "views/chair-train-a.h5"))
    assert kept.views.depth.shape == (8, 40, 48)
    other = define(inputs=[HISTOGRAM])
    item = make_plan(other, root).items[0]
    views = ViewStore(out / "views")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ocnf_data.generation.sample.render_depth", None)
        reused = make_sample(other, item, root, known=views)
        with pytest.raises(TypeError):
            make_sample(define(camera={"rig": "fibonacci9"}), item, root, known=views)
    assert reused.members == make_sample(other, item, root).members
    fresh, again = tmp_path / "fresh", tmp_path / "again"
    generate(other, fresh, root, progress=False)
    generate(other, again, root, views=out / "views", progress=False)
    assert contents(fresh) == contents(again)


def test_keeping_views_is_repeatable_and_survives_damage(meshes, define, tmp_path, contents) -> None:
    root, out, again = meshes("ab"), tmp_path / "out", tmp_path / "again"
    generate(define(views="keep"), out, root, progress=False)
    shutil.copytree(out / "views", again / "views")
    damaged = again / "views/chair-train-a.h5"
    damaged.write_bytes(damaged.read_bytes()[:1000])
    generate(define(views="keep"), again, root, progress=False)
    assert contents(out) == contents(again)


def test_views_that_are_not_there(meshes, define, tmp_path) -> None:
    with pytest.raises(OcnfError, match="no folder of views"):
        generate(define(), tmp_path / "out", meshes("a"), views=tmp_path / "nowhere", progress=False)
    with pytest.raises(OcnfError, match="memory"):
        generate(define(views="keep"), "memory://kept", meshes("a"), progress=False)


def test_views_of_other_items_or_cameras_are_noticed(meshes, define, tmp_path, contents) -> None:
    root = meshes("ab")
    generate(define(views="keep"), tmp_path / "kept", root, progress=False)
    with pytest.raises(OcnfError, match="no views of any of the items") as error:
        generate(define(), tmp_path / "out", root, views=tmp_path / "kept", progress=False)
    assert error.value.fix is not None and "`views`" in error.value.fix
    nearer = define(camera={"rig": "fibonacci9"})
    report = generate(nearer, tmp_path / "nearer", root, views=tmp_path / "kept/views", progress=False)
    assert any("other cameras" in warning for warning in report.warnings)
    generate(nearer, tmp_path / "rendered", root, progress=False)
    assert contents(tmp_path / "nearer") == contents(tmp_path / "rendered")


def test_failures_do_not_say_where_the_meshes_lie(meshes, define, tmp_path) -> None:
    """So that the same meshes in another folder give the same bytes."""
    root = meshes("ab")
    broken = next(root.rglob("*a.*"))
    broken.write_text("OFF\n3 1 0\n0 0 0\n")
    shutil.copytree(root, tmp_path / "elsewhere")
    rows = []
    for where in (root, tmp_path / "elsewhere"):
        out = tmp_path / f"out-{len(rows)}"
        report = generate(define(), out, where, progress=False)
        assert [failure.code for failure in report.failures] == ["unreadable"]
        rows.append((out / "failures.jsonl").read_bytes())
    assert rows[0] == rows[1] and str(tmp_path).encode() not in rows[0]
