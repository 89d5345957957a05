"""What is drawn: uniform rotations and directions, shares by weight, out of (seed, epoch, number) alone."""

from __future__ import annotations

import numpy as np
import pytest

from ocnf_data.synthesis.draw import draw_body, draw_look
from ocnf_data.synthesis.sources import open_sources
from ocnf_data.views.rigs import rig_from_name, view_subset

N = 1500


def opened(small, section, **changes):
    return open_sources(small(section, **changes), None, "train")


def test_any_rotation_is_uniform(small):
    """Haar measure: every entry has mean 0 and second moment 1/3, and the angle density (1 - cos t) / pi."""
    sources = opened(small, {"rotate": "any"})
    R = np.stack([draw_body(sources, 0, 0, i).rotation for i in range(N)])
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    np.testing.assert_allclose(R.mean(axis=0), 0, atol=4 * (1 / 3 / N) ** 0.5)
    np.testing.assert_allclose((R**2).mean(axis=0), 1 / 3, atol=4 * (4 / 45 / N) ** 0.5)
    angle = np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1) / 2, -1, 1))
    for t in (0.5, 1.0, 2.0, 2.6):
        assert np.mean(angle < t) == pytest.approx((t - np.sin(t)) / np.pi, abs=4 * 0.5 / N**0.5)


def test_upright_turns_about_the_axis_that_points_up_in_the_source(small, tmp_path):
    for i in range(20):  # procedural shapes stand on z = 0, whatever `up` says of mesh files
        R = draw_body(opened(small, {"rotate": "upright", "up": "y"}), 0, 0, i).rotation
        np.testing.assert_allclose(R @ [0, 0, 1], [0, 0, 1], atol=1e-15)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    manifest = small({"rotate": "upright", "up": "y"}, source={"kind": "list", "items": {"train": ["a.off"]}})
    sources = open_sources(manifest, tmp_path, "train")
    turned = np.stack([draw_body(sources, 0, 0, i).rotation for i in range(200)])
    np.testing.assert_allclose(turned @ [0, 1, 0], np.broadcast_to([0, 1, 0], (200, 3)), atol=1e-15)
    assert np.abs(turned.mean(axis=0)[[0, 2], [0, 2]]).max() < 0.2  # all around


def test_names_and_sources_come_as_often_as_their_weights_say(small):
    source = {"kind": "mixture", "parts": [
        {"weight": 3, "source": {"kind": "shapes", "categories": ["mug"], "counts": {"train": 1}}},
        {"source": {"kind": "shapes", "categories": ["chair", "table"], "counts": {"train": 1}}}]}
    sources = opened(small, {"rotate": {"none": 1, "any": 3}}, source=source)
    bodies = [draw_body(sources, 0, 0, i) for i in range(N)]
    for share, found in ((0.75, [body.item.category == "mug" for body in bodies]),
                         (0.125, [body.item.category == "table" for body in bodies]),
                         (0.75, [body.rotation is not None for body in bodies])):
        assert np.mean(found) == pytest.approx(share, abs=4 * (share * (1 - share) / N) ** 0.5)
    assert len({body.item.index for body in bodies}) == N  # shapes never come again


def test_looks_stay_in_their_ranges_and_fill_them(small):
    sources = opened(small, {"views": [2, 5], "sigma": [0.01, 0.03], "scale": [0.5, 0.9],
                             "directions": {"rig": 1, "random": 1, "sphere": 1}})
    looks = [draw_look(sources, 0, 0, i) for i in range(N)]
    counts = np.bincount([len(look.views) for look in looks], minlength=6)
    np.testing.assert_allclose(counts[2:] / N, 0.25, atol=0.05)
    sigma = np.array([look.sigma for look in looks])
    assert sigma.min() >= 0.01
    assert sigma.max() < 0.03
    assert np.ptp(sigma) > 0.0195
    scales = [draw_body(sources, 0, 0, i).scale for i in range(200)]
    assert min(scales) >= 0.5
    assert max(scales) < 0.9
    rig = rig_from_name("fibonacci12")
    kinds = {"rig": 0, "random": 0, "sphere": 0}
    for look in looks:
        assert look.directions.shape == (len(look.views), 3)
        np.testing.assert_allclose(np.linalg.norm(look.directions, axis=1), 1)
        if not (look.directions[:, None] == rig[None]).all(axis=2).any(axis=1).all():
            kinds["sphere"] += 1
            assert look.views == tuple(range(len(look.views)))
        elif look.views == tuple(view_subset(12, len(look.views))):
            kinds["rig"] += 1
        else:
            kinds["random"] += 1
            assert len(set(look.views)) == len(look.views)
    assert min(kinds.values()) > 0.28 * N


def test_random_views_and_directions_are_even(small):
    sources = opened(small, {"directions": "random"})
    looks = [draw_look(sources, 0, 0, i) for i in range(N)]
    share = np.bincount([view for look in looks for view in look.views], minlength=12)
    np.testing.assert_allclose(share / share.sum(), 1 / 12, atol=0.02)
    sources = opened(small, {"directions": "sphere"})
    sphere = np.concatenate([draw_look(sources, 0, 0, i).directions for i in range(N)])
    np.testing.assert_allclose(sphere.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose(sphere.T @ sphere / len(sphere), np.eye(3) / 3, atol=0.03)


def test_noise_is_fresh_in_every_epoch_and_sample(small):
    sources = opened(small, {})
    keys = {(look.seed, look.key) for look in (draw_look(sources, seed, epoch, i)
                                               for seed in range(2) for epoch in range(3) for i in range(5))}
    assert len(keys) == 30


def test_the_order_in_which_a_manifest_lists_names_does_not_matter(small):
    one = opened(small, {"rotate": {"none": 1, "any": 2}, "directions": {"rig": 1, "random": 2}})
    other = opened(small, {"rotate": {"any": 2, "none": 1}, "directions": {"random": 2, "rig": 1}})
    assert one.checksum == other.checksum
    for i in range(50):
        assert draw_look(one, 0, 0, i).views == draw_look(other, 0, 0, i).views
        a, b = (draw_body(sources, 0, 0, i).rotation for sources in (one, other))
        np.testing.assert_array_equal(np.eye(3) if a is None else a, np.eye(3) if b is None else b)


@pytest.mark.parametrize(("changes", "same"), [
    ({"name": "other"}, True),
    ({"inputs": [{"name": "v1", "views": 1, "encodings": ["tsdf"]}]}, True),
    ({"shards": {"samples": 7}}, True),
    ({"truncation_voxels": 3.0}, False),
    ({"seed": 4}, False),
    ({"normalise": {"extent": 2.9}}, False),
    ({"source": {"kind": "shapes", "categories": ["chair", "mug"], "counts": {"train": 6}}}, False),
])
def test_the_checksum_holds_what_samples_depend_on(small, changes, same):
    assert (open_sources(small(**changes), None, "train").checksum
            == open_sources(small(), None, "train").checksum) is same
    off = [open_sources(small({"misaligned": share}, resolutions=[16, finest]), None, "train").checksum
           for share in ([0, 0], [0, 1]) for finest in (32, 64)]
    assert off[0] == off[1] and len(set(off)) == 3  # poses are off by shares of the finest voxel
    assert open_sources(small(), None, "val").checksum != open_sources(small(), None, "train").checksum
