"""Scenes among the samples: where they and their cameras stand, and their ground truth by brute force."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from torch.utils.data import DataLoader

from ocnf_data import SynthesisDataset
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.manifest.synthesis import SceneCameras
from ocnf_data.render import render_depth
from ocnf_data.scenes import SCENES, draft_scene, make_scene
from ocnf_data.synthesis.draw import Body, Look, draw_body, draw_look
from ocnf_data.synthesis.sample import make_inputs, make_truths, pose
from ocnf_data.synthesis.scenes import PlacedScene, look_cameras, truth_cameras
from ocnf_data.synthesis.sources import open_sources
from ocnf_data.views.noise import NoiseModel

N = 6


def scenes(*kinds: str) -> dict[str, Any]:
    return {"kind": "scenes", "categories": list(kinds), "counts": {"train": 2, "val": 2}}


@pytest.fixture(scope="module")
def mixed(small: Any) -> Any:
    """Shapes and scenes, three quarters of them scenes."""
    def make(**section: Any) -> Any:
        return small({"rotate": {"none": 1, "any": 2}, "zoom": [1.0, 3.0], "samples_per_epoch": N,
                      "noise": {"park": 1, "kinect": 1}, **section},
                     source={"kind": "mixture", "parts": [
                         {"source": {"kind": "shapes", "categories": ["mug"], "counts": {"train": 1}}},
                         {"weight": 3, "source": scenes("rooms", "tabletops")}]})
    return make


def drawn(manifest: Any, n: int = 10) -> list[tuple[Body, Look, PlacedScene]]:
    """Bodies that are scenes, looks at them, and where they stand."""
    sources, found = open_sources(manifest, None, "train"), []
    for number in range(n):
        body = draw_body(sources, 0, 0, number)
        if body.is_scene:
            placed = pose(manifest, body, None).scene
            assert placed is not None
            found.append((body, draw_look(sources, 0, 0, number), placed))
    return found


def turned(body: Body) -> np.ndarray:
    return np.eye(3) if body.rotation is None else body.rotation


def test_scenes_come_by_weight_and_never_again(mixed: Any) -> None:
    sources = open_sources(mixed(), None, "train")
    bodies = [draw_body(sources, 0, 0, i) for i in range(600)]
    share = np.mean([body.is_scene for body in bodies])
    assert share == pytest.approx(0.75, abs=4 * (0.75 * 0.25 / 600) ** 0.5)
    assert {body.item.category for body in bodies} == {"mug", *SCENES}
    assert len({body.item.source for body in bodies}) == 600
    zooms = np.array([body.zoom for body in bodies if body.is_scene])
    assert zooms.min() >= 1 and zooms.max() < 3
    assert np.median(zooms) == pytest.approx(3**0.5, rel=0.1)  # the logarithm is even
    assert all(body.zoom == 1 for body in bodies if not body.is_scene)


def test_the_whole_scene_is_turned_centred_and_scaled_like_a_mesh(mixed: Any) -> None:
    manifest = mixed(zoom=[1, 1], scale=[0.7, 1.0])
    for body, _, placed in drawn(manifest, 6):
        assert body.item.index is not None
        mesh = make_scene(body.item.category, manifest.seed, body.item.index, "train")
        points = np.array([turned(body) @ vertex for vertex in mesh.vertices])
        low, high = points.min(axis=0), points.max(axis=0)
        factor = 0.95 * 3 / (high - low).max() * body.scale
        np.testing.assert_allclose(pose(manifest, body, None).vertices, (points - (low + high) / 2) * factor,
                                   atol=1e-9)
        assert placed.metres == pytest.approx(1 / factor)


def test_zoomed_the_cube_is_smaller_and_within_the_scene(mixed: Any) -> None:
    at = set()
    manifest = mixed()
    for body, _, placed in drawn(manifest):
        vertices = pose(manifest, body, None).vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        assert (high - low).max() == pytest.approx(0.95 * 3 * body.zoom)
        wide = high - low > 3
        assert (low[wide] < -1.5 + 1e-9).all() and (high[wide] > 1.5 - 1e-9).all()
        np.testing.assert_allclose((low + high)[~wide], 0, atol=1e-9)
        at.add(tuple(np.round(low + high, 3)))
        assert placed.side == pytest.approx(3 * placed.metres)
    assert len(at) > 4


def test_cameras_stand_free_inside_rooms_and_above_tables(mixed: Any) -> None:
    for body, look, placed in drawn(mixed(views=[3, 6])):
        boxes = np.array([(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part, _ in draft_scene(
            body.item.category, 3, body.item.index or 0, "train").parts])
        for R, T in (truth_cameras(placed, 3, 20), look_cameras(placed, look)):
            stand = -np.einsum("vji,vj->vi", R, T)
            p = (stand - placed.offset) @ placed.rotation * placed.metres  # in the scene
            np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (len(R), 1, 1)),
                                       atol=1e-9)
            for place in p:
                apart = [np.linalg.norm(np.clip(place, *box) - place) for box in boxes]
                assert min(apart) > (0.19 if body.item.category == "rooms" else 0.05)
            low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
            if body.item.category == "rooms":
                assert (p > low).all() and (p < high).all()
            else:
                assert (p[:, 2] > 0).all()
        assert len(look_cameras(placed, look)[0]) == len(look.views)


@pytest.mark.parametrize("kind", SCENES)
def test_the_ground_truth_is_that_of_the_scene_in_its_own_metres(small: Any, kind: str) -> None:
    """Rendered and fused where it stands, in float64 and voxel by voxel, without the cube's coordinates."""
    manifest = small({"rotate": "any", "zoom": [1.5, 2.5]}, source=scenes(kind))
    (body, _, placed), *_ = drawn(manifest, 1)
    found = make_truths(manifest, pose(manifest, body, None), (32,))[32].to_grid().to_dense()[0]

    mesh = make_scene(kind, manifest.seed, body.item.index or 0, "train")
    R, T = truth_cameras(placed, manifest.seed, 12)
    stand = (-np.einsum("vji,vj->vi", R, T) - placed.offset) @ turned(body) * placed.metres
    R = R @ turned(body)
    T = -np.einsum("vij,vj->vi", R, stand)
    camera = manifest.camera
    depth = render_depth(mesh.vertices, mesh.faces, camera.K, R, T, camera.size).astype(np.float64)

    tau, side = manifest.truncation(32) * placed.metres, 3 * placed.metres
    axis = (np.arange(32) + 0.5) * side / 32 - side / 2
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    points = (np.stack([x, y, z], axis=-1) - placed.offset * placed.metres) @ turned(body)
    total, count = np.zeros((32, 32, 32)), np.zeros((32, 32, 32))
    for image, turn, move in zip(depth, R, T, strict=True):
        u, v, far = np.moveaxis(points @ (camera.K @ turn).T + camera.K @ move, -1, 0)
        with np.errstate(all="ignore"):
            u, v = np.floor(u / far + 0.5), np.floor(v / far + 0.5)
        inside = (far > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        ahead = np.full(far.shape, -np.inf)
        ahead[inside] = image[v[inside].astype(int), u[inside].astype(int)] - far[inside]
        total += np.where(ahead >= -tau, np.minimum(ahead, tau), 0)
        count += ahead >= -tau
    expected = np.where(count > 0, total / np.maximum(count, 1) / tau, -1.0)
    off = np.abs(found - expected) > 1e-3  # half floats and the octree's tolerance; else a pixel's rounding
    assert off.mean() < 2e-3
    assert (np.abs(expected) < 1).mean() > 0.02 and (expected == 1).mean() > 0.1


def test_without_a_background_what_meets_nothing_is_not_measured(small: Any) -> None:
    manifest = small({}, source=scenes("tabletops"))
    (body, _, _), *_ = drawn(manifest, 1)
    posed = pose(manifest, body, None)
    free = []
    for background in (True, False):
        look = Look(None, (0, 1, 2), NoiseModel.PARK, 0, "k", background=background)
        octree = make_inputs(manifest, posed, look, Encoding.OCCUPANCY, (32,))[32]
        free.append(octree.to_grid().to_dense()[0] == 0)
    assert free[1].sum() < 0.7 * free[0].sum() and free[1].any()
    assert not (free[1] & ~free[0]).any()


def test_kinect_noise_is_that_of_real_metres(small: Any) -> None:
    """A room's distances are beyond half a metre, whatever the manifest's `metres` say of meshes."""
    manifest = small({"metres": 0.01, "views": [3, 3], "noise": "kinect"}, source=scenes("rooms"))
    (body, look, _), *_ = drawn(manifest, 1)
    octree = make_inputs(manifest, pose(manifest, body, None), look, Encoding.OCCUPANCY, (32,))[32]
    assert (octree.to_grid().to_dense() == 0).mean() > 0.05  # at 0.01 nothing would be measured


def contents(batch: Any) -> tuple[Any, ...]:
    return (batch.epoch, batch.step, batch.keys, batch.repeat, batch.meta, batch.arena.numpy().tobytes())


def open_set(manifest: Any, **arguments: Any) -> SynthesisDataset:
    return SynthesisDataset(manifest, [16], "histogram", batch_size=2, rank=0, world_size=1, **arguments)


def test_samples_of_scenes_depend_on_seed_epoch_and_number_alone(mixed: Any, tmp_path: Any) -> None:
    manifest = mixed(repeat=2)
    dataset = open_set(manifest)
    wanted = [contents(batch) for _ in range(2) for batch in dataset]
    other = open_set(manifest, cache=tmp_path)  # ground truths out of the cache, in another process
    loader = DataLoader(other, batch_size=None, num_workers=1, persistent_workers=True)
    assert [contents(batch) for _ in range(2) for batch in loader] == wanted
    resumed = open_set(manifest)
    resumed.load_state_dict({**resumed.state_dict(), "epoch": 1, "step": 1})
    assert contents(next(iter(resumed))) == wanted[N // 2 + 1]
    assert [c[5] for c in wanted] != [contents(batch)[5] for batch in open_set(manifest, seed=1)]
    meta = [m for c in wanted for m in c[4] if m["category"] in SCENES]
    assert meta
    assert all(m.keys() >= {"zoom", "metres", "cameras", "background"} for m in meta)
    assert not any("directions" in m for m in meta)


def test_scenes_alone_may_have_the_rig_of_their_validation(small: Any) -> None:
    camera = {"rig": "inside8", "width": 64, "height": 48, "fx": 35, "fy": 34, "cx": 31, "cy": 25}
    section = {"views": [2, 8], "cameras": "path"}
    manifest = small(section, source=scenes("rooms"), camera=camera,
                     inputs=[{"name": "a", "views": 2, "encodings": ["tsdf"]}])
    (_, look, placed), *_ = drawn(manifest, 1)
    assert look.directions is None and look.cameras is SceneCameras.PATH
    assert len(look_cameras(placed, look)[0]) == len(look.views) <= 8
    with pytest.raises(OcnfError, match="anything but scenes"):
        small(section, camera=camera)


def test_the_sums_of_manifests_without_scenes_are_what_they_were(small: Any) -> None:
    assert open_sources(small(), None, "train").checksum == (
        "e716fd552068e76ab9cb3f6d3a67bb682f4c137164e8006e0e48b2847d1a1be3")


def test_poses_that_do_not_fit_change_the_input_alone(mixed: Any) -> None:
    """The views of a look are what they were; they are fused where a tracker would have them."""
    exact, off = mixed(), mixed(misaligned=[1.0, 2.0])
    sources = [open_sources(manifest, None, "train") for manifest in (exact, off)]
    shares = []
    for number in range(4):
        body, other = (draw_body(source, 0, 0, number) for source in sources)
        assert (body.item, body.scale, body.zoom) == (other.item, other.scale, other.zoom)
        look, moved = (draw_look(source, 0, 0, number) for source in sources)
        assert look.misaligned == 0 and 1 <= moved.misaligned < 2
        np.testing.assert_equal(vars(replace(moved, misaligned=0.0)), vars(look))
        posed = pose(exact, body, None)
        plain, found, again = (
            make_inputs(manifest, posed, chosen, Encoding.TSDF, (32,))[32]
            for manifest, chosen in ((exact, look), (exact, moved), (off, moved)))
        np.testing.assert_array_equal(found.trees, again.trees)
        np.testing.assert_array_equal(found.data, again.data)
        truths = [make_truths(manifest, posed, (32,))[32].data for manifest in (exact, off)]
        np.testing.assert_array_equal(*truths)
        shares.append(len(plain.data) != len(found.data) or not np.array_equal(plain.data, found.data))
    assert sum(shares) >= 3  # views may look past all there is
    assert len({draw_look(sources[1], 0, 0, number).misaligned for number in range(20)}) == 20


def test_a_sample_says_how_far_off_its_poses_are(small: Any) -> None:
    for off in ([0.0, 0.0], [1.0, 2.0]):
        sources = open_sources(small({"samples_per_epoch": 3, "misaligned": off}), None, "train")
        for number, batch in enumerate(SynthesisDataset(sources, [16], "tsdf", rank=0, world_size=1)):
            look = draw_look(sources, 0, 0, number)
            assert batch.meta[0].get("misaligned", 0.0) == look.misaligned
