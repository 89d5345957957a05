"""A data set of scans: reference and inputs are what was measured, whoever makes them; nothing is lost."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import trimesh

from ocnf_data import GridOctree, ShardDataset, fuse_tsdf, generate, load_manifest
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.export import export_dataset
from ocnf_data.generation.plan import make_plan
from ocnf_data.generation.remake import remake
from ocnf_data.inspection.check import check_measured_surface, check_sample
from ocnf_data.inspection.show import draw_sample
from ocnf_data.octree.surface import octree_surface
from ocnf_data.report.blob import unpack
from ocnf_data.report.run import write_report
from ocnf_data.report.sample import Choice, make_picture, stored_fusion
from ocnf_data.sequences.frames import FrameSequence
from ocnf_data.sequences.known import known_surface
from ocnf_data.shards.browse import StoredSample, stored_samples
from ocnf_data.shards.tarformat import target_member
from ocnf_data.verify.verify import verify
from ocnf_data.views.scans import read_scan
from ocnf_data.views.scans.listing import Said

from .conftest import BALL, RADIUS, ROOM, sequence_manifest, write_scan

UNITS = Said(depth_scale=10_000)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, scans: Path) -> Path:
    """The data set of `sequence_manifest`, made by one worker."""
    out = tmp_path_factory.mktemp("made") / "set"
    report = generate(sequence_manifest(), out, scans, jobs=1, progress=False)
    assert (report.items, report.samples, report.failures) == (5, 5, ())
    return out


def samples(url: Path) -> dict[str, StoredSample]:
    return {sample.key: sample for sample in stored_samples(str(url))}


def test_the_bytes_do_not_depend_on_the_workers(made: Path, scans: Path, tmp_path: Path) -> None:
    generate(sequence_manifest(), tmp_path / "two", scans, jobs=2, progress=False)
    moved = tmp_path / "elsewhere"  # where the scans lie is no part of the data set
    shutil.copytree(scans, moved)
    generate(sequence_manifest(), tmp_path / "moved", moved, jobs=1, progress=False)
    for other in ("two", "moved"):
        assert (tmp_path / other / "dataset.json").read_bytes() == (made / "dataset.json").read_bytes()
    assert verify(made).ok


def test_every_octree_is_what_its_frames_say_by_another_way(made: Path, scans: Path) -> None:
    """`check` evaluates every view in float64: all frames for the reference, the first k for an input."""
    for sample in samples(made).values():
        findings = list(check_sample(sample, sequence_manifest(), scans, 2000, 0))
        assert len(findings) == 2 * (3 + 3 * 2)
        assert not [one for one in findings if not one.ok]


def test_a_surface_that_no_frame_has_measured_is_found_out(made: Path, scans: Path) -> None:
    sample = samples(made)["long-test-0000"]
    views = remake(sequence_manifest(), sample.facts, scans).views
    truth = sample.octree("target-32.oct")
    assert check_measured_surface(truth, views, Encoding.TSDF, 3.0)[1]
    moved = GridOctree.from_dense(np.roll(truth.to_dense(), (2, 2, 2), axis=(1, 2, 3)), 0.0)
    assert not check_measured_surface(moved, views, Encoding.TSDF, 3.0)[1]
    free = GridOctree.from_dense(np.ones((1, 32, 32, 32), np.float32), 0.0)
    assert check_measured_surface(free, views, Encoding.TSDF, 3.0) == ("no zero crossing", False)


def test_the_reference_is_the_analytic_scene(made: Path) -> None:
    """Free, inside or unknown as the scene is, to within half a voxel of its surfaces."""
    sample = samples(made)["long-test-0000"]
    place, res = sample.facts["normalisation"], 32
    truth = sample.octree("target-32.oct").to_dense()[0]
    axis = (np.arange(res) + 0.5) * 3.0 / res - 1.5
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    points = np.stack([x, y, z], -1) / place["scale"] + place["centre"]
    ball = np.linalg.norm(points - BALL, axis=-1) - RADIUS
    walls = np.minimum(points - ROOM[0], ROOM[1] - points).min(-1)
    distance = np.minimum(ball, walls)  # negative in the ball and beyond the walls
    voxel = 3.0 / res / place["scale"]
    known, clear = truth > -1, np.abs(distance) > 0.5 * voxel
    assert ((truth < 0) == (distance < 0))[known & clear].mean() > 0.995
    assert (known & clear & (distance < 0)).sum() > 500
    free, deep = distance > 5 * voxel, distance < -3 * voxel
    assert free.sum() > 500 and (truth[free & known] == 1).all()
    assert deep.sum() > 500 and not known[deep].any()  # tau is 2.1 voxels


def test_what_the_facts_say_of_a_sample(made: Path, scans: Path) -> None:
    whole = FrameSequence.open(scans / "long", said=UNITS)
    used: dict[str, list[int]] = {"train": [], "test": []}
    for key, sample in samples(made).items():
        facts = sample.facts
        few, many = facts["inputs"]["v2"], facts["inputs"]["v5"]
        assert few["views"] == many["views"][:2] and len(many["views"]) == 5
        assert many["frames"] == [whole.names[i] for i in many["views"]]
        assert (facts["sha256"], facts["category"]) == (whole.checksum(), "long")
        assert facts["scan"]["frames"] == 30 and key.startswith(f"long-{facts['split']}-")
        truth = sample.octree("target-32.oct").to_dense()
        assert facts["observed"]["32"] == pytest.approx((truth > -1).mean(), abs=1e-3)
        used[facts["split"]] += many["views"]
    for frames in used.values():
        assert len(set(frames)) == len(frames)  # disjoint
    assert max(used["train"]) < 18 <= min(used["test"])  # 3 of 5 configurations: 18 of 30 frames, in time


def test_a_voxel_that_no_frame_counts_is_unseen_by_every_input_too(made: Path) -> None:
    for sample in samples(made).values():
        for res in (16, 32):
            unknown = sample.octree(f"target-{res}.oct").to_dense()[0] == -1
            assert 0.05 < unknown.mean() < 0.9
            # but for voxels that are counted at -tau to within what float16 holds
            assert (sample.octree(f"v5-histogram-{res}.oct").to_dense()[0][unknown] == 1).mean() > 0.999
            assert (sample.octree(f"v2-tsdf-{res}.oct").to_dense()[0][unknown] == -1).mean() > 0.999


def test_batches_of_it_load(made: Path) -> None:
    batches = list(ShardDataset(str(made), "train", [16, 32], "histogram", "v5", batch_size=2, shuffle=False,
                                uneven="exact", rank=0, world_size=1))
    assert [len(batch.keys) for batch in batches] == [2, 1]
    assert {key for batch in batches for key in batch.keys} == {f"long-train-{i:04d}" for i in range(3)}


def test_a_damaged_frame_costs_the_configurations_of_its_scan(scans: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    shutil.copytree(scans, root)
    frame = root / "short" / "frame-000007.depth.png"
    frame.write_bytes(frame.read_bytes()[:-40])
    manifest = sequence_manifest(scans="all", configurations={"test": 2})
    report = generate(manifest, tmp_path / "set", root, progress=False)
    assert (report.items, report.samples, len(report.failures)) == (4, 2, 2)
    for failure in report.failures:
        assert (failure.code, failure.stage, failure.category) == ("damaged", "read", "short")
        assert "short/frame-000007.depth.png" in failure.message and str(root) not in failure.message
    assert verify(tmp_path / "set").ok


@pytest.mark.parametrize("name, refused", [
    ("frame-000003.depth.png", True), ("frame-000003.pose.txt", True), ("camera-intrinsics.txt", True),
    ("frame-000003.color.png", False), ("notes.txt", False)])
def test_a_changed_scan_is_refused_on_resume(scans: Path, tmp_path: Path, name: str, refused: bool) -> None:
    root = tmp_path / "root"
    write_scan(root / "long", 12)
    manifest = sequence_manifest(configurations={"test": 2})
    generate(manifest, tmp_path / "set", root, progress=False)
    changed = root / "long" / name
    match changed.suffix:
        case ".png":
            shutil.copy(root / "long" / "frame-000004.depth.png", changed)
        case ".txt" if refused:
            numbers = np.loadtxt(changed)
            numbers[0, -1] += 1e-3
            np.savetxt(changed, numbers)
        case _:
            changed.write_text("a note\n")
    if refused:
        with pytest.raises(OcnfError, match=r"a scan of test has changed; found sha256 \w+, expected sha256"):
            generate(manifest, tmp_path / "set", root, progress=False)
    else:
        assert generate(manifest, tmp_path / "set", root, progress=False).made == 0


def test_frames_that_are_left_out_and_poses_that_look_wrong_are_said(scans: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    write_scan(root / "long", 12)
    lost = root / "long" / "frame-000002.pose.txt"
    np.savetxt(lost, np.full((4, 4), np.nan))
    manifest = sequence_manifest(configurations={"test": 1})
    report = generate(manifest, tmp_path / "set", root, progress=False)
    assert report.warnings == (
        "long: 1 frame whose pose is not known (NaN or infinite), left out: frame-000002",)
    sample = samples(tmp_path / "set")["long-test-0000"]
    assert sample.facts["scan"]["frames"] == 11
    turned = sequence_manifest(configurations={"test": 1},
                               reading={"depth_scale": 10_000, "poses": "world-to-camera"})
    report = generate(turned, tmp_path / "turned", scans, progress=False)
    assert any("the other way round" in warning for warning in report.warnings)


def test_too_few_frames_for_disjoint_subsets_are_refused_before_anything_is_made(
        scans: Path, tmp_path: Path) -> None:
    manifest = sequence_manifest(scans=["long", "short"], configurations={"test": 3})
    with pytest.raises(OcnfError, match=r"short: .*test: too few frames; found 12 frames for test, expected "
                                        r"at least 15, for 3 configurations of 5 views"):
        generate(manifest, tmp_path / "set", scans, progress=False)
    assert not list((tmp_path / "set").glob("*"))
    dealt_again = sequence_manifest(scans=["short"], configurations={"test": 3}, disjoint=False)
    assert len(make_plan(dealt_again, scans).items) == 3


def test_the_shipped_manifest_takes_scans_of_any_length(tmp_path: Path) -> None:
    manifest = load_manifest(Path(__file__).parents[3] / "manifests" / "paper-kinect.yaml")
    for n in (20, 41):
        write_scan(tmp_path / f"of{n}", n)
    entries = manifest.entries(tmp_path)
    assert Counter(entry.path for entry in entries) == {"of20": 20, "of41": 20}


def test_scans_of_their_own_splits(scans: Path) -> None:
    manifest = sequence_manifest(scans=["long", {"path": "short", "configurations": {"test": 2}}],
                                 configurations={"train": 4, "val": 1})
    plan = make_plan(manifest, scans)
    assert {shard.split: {item.category for item in shard.items} for shard in plan.shards} == {
        "train": {"long"}, "val": {"long"}, "test": {"short"}}


def test_a_sample_can_be_made_again_and_drawn(made: Path, scans: Path, tmp_path: Path) -> None:
    sample = samples(made)["long-train-0001"]
    again = remake(sequence_manifest(), sample.facts, scans)
    indices = sample.facts["inputs"]["v2"]["views"]
    raw = read_scan(scans / "long", depth_scale=10_000).views.depth
    scale = sample.facts["normalisation"]["scale"]
    np.testing.assert_allclose(again.observed["v2"].depth, raw[indices] * scale, rtol=1e-6)
    draw_sample(sample, sequence_manifest(), tmp_path / "a.png", scans)
    assert (tmp_path / "a.png").stat().st_size > 10_000
    with pytest.raises(OcnfError, match="the folder of the meshes or scans is not given"):
        draw_sample(sample, sequence_manifest(), tmp_path / "b.png")


def test_its_page_shows_the_frames_that_it_was_made_of(made: Path, scans: Path, tmp_path: Path) -> None:
    manifest = sequence_manifest()
    choice = Choice(manifest.inputs[1], 32, 10**6, "z")  # of histograms alone
    done = write_report(str(made), tmp_path / "page.html", meshes=scans, variant="v5", triangles=10**6)
    assert (done.n_samples, done.failures) == (5, [])
    for sample in samples(made).values():
        facts = sample.facts["inputs"]["v5"]
        picture = make_picture(sample, manifest, choice, scans, [stored_fusion(sample, choice)])
        arrays, meta = unpack(picture.blob)
        assert [depth["title"] for depth in meta["depths"]] == [f"{facts['frames'][0]}, as measured",
                                                                *facts["frames"]]
        scale, centre = sample.facts["normalisation"]["scale"], sample.facts["normalisation"]["centre"]
        measured = read_scan(scans / "long", depth_scale=10_000).views.depth[facts["views"]] * scale
        assert meta["depths"][0]["limits"] == pytest.approx([measured.min(), measured.max()], rel=1e-5)
        truth, fused = sample.octree("target-32.oct"), sample.octree("v5-histogram-32.oct")
        centres = np.linspace(-1.125, 1.125, 10, dtype=np.float32)
        mean = fused.with_data((fused.data @ centres).clip(-1, 1)[:, None])
        triangles = {shown["name"]: shown["of"] for shown in meta["shown"] if shown["kind"] == "surface"}
        assert triangles == {"All frames": len(known_surface(truth, 3.0)[1]),
                             "VolFus*": len(known_surface(mean, 3.0, truth)[1]),
                             "Ground truth": len(known_surface(truth, 3.0)[1])}
        assert triangles["VolFus*"] < 0.9 * len(octree_surface(mean, 3.0)[1])  # no walls around the unknown
        points = arrays["surface1/positions"] / 65535 * 3.0 - 1.5
        off = np.linalg.norm(points / scale + centre - BALL, axis=1) - RADIUS
        on_walls = np.abs((points / scale + centre)[:, :, None] - ROOM.T).min(axis=(1, 2))
        assert np.minimum(np.abs(off), on_walls).max() < 0.002


def test_kept_views_are_the_frames_of_the_configuration(scans: Path, tmp_path: Path) -> None:
    """`ocnf-model fuse RUN OUT/views/KEY.h5` so works on the very input of a sample."""
    manifest = sequence_manifest({"views": "keep"}, configurations={"test": 1})
    generate(manifest, tmp_path / "set", scans, progress=False)
    kept = read_scan(f"{tmp_path}/set/views/long-test-0000.h5")
    assert len(kept.views) == 5 and kept.cube == ((0.0, 0.0, 0.0), 3.0)
    fused = fuse_tsdf(kept.views.subset([0, 1]), 32, 3.0, manifest.truncation(32))
    stored = samples(tmp_path / "set")["long-test-0000"].octree("v2-tsdf-32.oct")
    np.testing.assert_allclose(fused.to_dense(), stored.to_dense(), atol=1 / 255)


@pytest.mark.parametrize("source, rest, message", [
    ({}, {"camera": {"rig": "icosphere0"}}, "camera: the cameras of scans are their own"),
    ({}, {"synthesis": {}}, "synthesis: samples without end"),
    ({"configurations": {"test": 0}}, {}, "source.configurations: the data set would be empty"),
    ({"region": [0, 0, 0, 1, 1, 0]}, {}, "source.region: not a region"),
    ({"region": "all"}, {}, "source.region: not a region"),
    ({"scans": []}, {}, "source.scans: not a list of scans"),
    ({"frames": "many"}, {}, "source.frames: not a choice of frames"),
    ({"reading": {"format": "kitti"}}, {}, "source.reading.format: no such format of scans"),
])
def test_manifests_that_are_refused(source: dict[str, object], rest: dict[str, object], message: str) -> None:
    with pytest.raises(OcnfError, match=message):
        sequence_manifest(rest, **source)


def test_scans_that_are_refused(scans: Path, tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match="no scan found"):
        make_plan(sequence_manifest(scans="all"), tmp_path)
    with pytest.raises(OcnfError, match="a scan is listed twice; found long"):
        make_plan(sequence_manifest(scans=["long", "./long"]), scans)
    with pytest.raises(OcnfError, match="no such scan"):
        make_plan(sequence_manifest(scans=["short", "none"], configurations={"test": 1}), scans)
    far = sequence_manifest(configurations={"test": 1}, region=[50, 50, 50, 51, 51, 51])
    report = generate(far, tmp_path / "far", scans, progress=False)
    assert [(row.code, row.stage) for row in report.failures] == [("invisible", "normalise")]
    rows = (tmp_path / "far" / "failures.jsonl").read_text().splitlines()
    assert "no frame has measured anything in the region" in json.loads(rows[0])["message"]


def test_what_no_frame_has_seen_is_not_exported_as_a_surface(made: Path, tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match="format: most of a scan's cube was never looked at"):
        export_dataset(made, tmp_path / "points", "points")
    assert not (tmp_path / "points").exists()
    manifest = sequence_manifest()
    finest, extent = manifest.resolutions[-1], manifest.normalise.extent
    export_dataset(made, tmp_path / "meshes", "mesh", resolution=finest)
    for sample in stored_samples(str(made)):
        mesh = trimesh.load(tmp_path / "meshes" / sample.split / f"{sample.key}.ply", process=False)
        vertices, faces = known_surface(sample.octree(target_member(finest)), extent)
        assert len(mesh.faces) == len(faces) > 0
        np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-5)
        assert np.abs(mesh.vertices).max() < extent / 2 * 0.999  # not the walls of the cube
