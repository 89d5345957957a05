"""Fusion into octrees equals the dense oracle, voxel by voxel and tree by tree."""

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import (
    DepthPyramid,
    default_truncation,
    fuse,
    fuse_histogram,
    fuse_occupancy,
    fuse_tdf_occupancy,
    fuse_tsdf,
)
from ocnf_data.octree import GridOctree
from ocnf_data.views.cameras import Views

ENCODINGS = list(Encoding)


def assert_fused(octree, dense, encoding):
    """Values within the split tolerance and float32 rounding; structure that of from_dense; ties left out."""
    expected = dense.values[encoding].astype(np.float32)
    assert octree.shape == expected.shape[1:]
    wrong = np.abs(octree.to_dense() - expected).max(axis=0) > 1e-6 * encoding.span + 1e-6
    assert not (wrong & ~dense.tie).any()
    reference = GridOctree.from_dense(expected, tolerance=1e-6 * encoding.span)
    gd, gh, gw = (n // 8 for n in octree.shape)
    tied = dense.tie.reshape(gd, 8, gh, 8, gw, 8).any(axis=(1, 3, 5))
    differs = (octree.trees != reference.trees).any(axis=-1)
    assert not (differs & ~tied).any()


def random_scene(seed, n_views, distance, smooth):
    """Random cameras and depth maps with patches of free and missing pixels."""
    rng = np.random.default_rng(seed)
    height, width = int(rng.integers(1, 60)), int(rng.integers(1, 60))
    R, _ = np.linalg.qr(rng.normal(size=(n_views, 3, 3)))
    R[np.linalg.det(R) < 0] *= -1
    T = np.stack([*rng.normal(scale=0.3, size=(2, n_views)), rng.normal(distance, 0.2, n_views)], axis=-1)
    K = np.zeros((n_views, 3, 3))
    K[:, 0, 0], K[:, 1, 1] = rng.uniform(5, 60, (2, n_views))
    K[:, 0, 2], K[:, 1, 2] = rng.uniform(-10, 60, (2, n_views))
    K[:, 2, 2] = 1
    depth = rng.uniform(0.01, 2 * abs(distance) + 1, (n_views, height, width))
    if smooth:
        depth = distance + 0.1 * np.sin(np.arange(width) / 7) + 0.05 * rng.normal(size=(n_views, height, 1))
    depth = np.abs(depth) * np.ones((n_views, height, width))
    for special in (np.inf, 0.0):
        for view in range(n_views):
            for _ in range(rng.integers(0, 4)):
                i, j = rng.integers(0, height), rng.integers(0, width)
                depth[view, i : i + rng.integers(1, 40), j : j + rng.integers(1, 40)] = special
    return Views(depth.astype(np.float32), K, R, T)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_views=st.sampled_from([1, 2, 5, 80]),
    distance=st.sampled_from([-3.0, 0.0, 0.5, 1.5, 3.0, 8.0]),
    smooth=st.booleans(),
    shape=st.sampled_from([8, 16, 24, 32, (8, 24, 16), (40, 8, 8)]),
    extent=st.sampled_from([3.0, 0.7, 10.0]),
    voxels=st.sampled_from([None, 0.3, 1.0, 5.0, 40.0]),
    encoding=st.sampled_from(ENCODINGS),
    centre=st.sampled_from([(0.0, 0.0, 0.0), (0.3, -0.2, 0.5)]),
)
def test_equals_the_oracle(oracle, seed, n_views, distance, smooth, shape, extent, voxels, encoding, centre):
    views = random_scene(seed, n_views, distance, smooth)
    dims = (shape,) * 3 if isinstance(shape, int) else shape
    length = None if voxels is None else voxels * extent / max(dims)
    if encoding is Encoding.OCCUPANCY:
        octree = fuse_occupancy(views, shape, extent, threshold=length, centre=centre)
        dense = oracle(views, dims, extent, threshold=length, centre=centre)
    else:
        octree = fuse(views, encoding, shape, extent, length, centre=centre)
        dense = oracle(views, dims, extent, truncation=length, centre=centre)
    assert_fused(octree, dense, encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("body", ["sphere", "box", "plane"])
def test_bodies_equal_the_oracle(oracle, scenes, body, encoding):
    assert_fused(fuse(scenes[body], encoding, 64), oracle(scenes[body], (64, 64, 64)), encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_free_and_unseen_space_are_exact_constants(scenes, oracle, encoding):
    views = scenes["sphere"]
    free_value = {Encoding.TSDF: [1], Encoding.TDF_OCCUPANCY: [1, 0], Encoding.OCCUPANCY: [0],
                  Encoding.HISTOGRAM: [0] * 9 + [1]}[encoding]
    unseen_value = {Encoding.TSDF: [-1], Encoding.TDF_OCCUPANCY: [1, 1], Encoding.OCCUPANCY: [1],
                    Encoding.HISTOGRAM: [1] + [0] * 9}[encoding]
    tsdf = oracle(views, (64, 64, 64)).values[Encoding.HISTOGRAM]
    fused = fuse(views, encoding, 64).to_dense()
    free, unseen = tsdf[9] == 1, tsdf[0] == 1
    assert free.mean() > 0.3
    assert unseen.mean() > 0.01
    np.testing.assert_array_equal(np.unique(fused[:, free], axis=1)[:, 0], free_value)
    assert np.ptp(fused[:, free], axis=1).max() == 0
    np.testing.assert_array_equal(np.unique(fused[:, unseen], axis=1)[:, 0], unseen_value)
    assert np.ptp(fused[:, unseen], axis=1).max() == 0


def test_an_infinite_ray_carves_and_a_missing_pixel_says_nothing(scenes):
    views = scenes["box"]
    everywhere = views.with_depth(np.full_like(views.depth, np.inf))
    nowhere = views.with_depth(np.zeros_like(views.depth))
    seen = fuse_tsdf(everywhere, 32).to_dense()
    assert (seen == 1).mean() > 0.5
    unseen = fuse_tsdf(nowhere, 32)
    assert unseen.n_leaves == 64
    assert (unseen.data == -1).all()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_octree_is_valid(scenes, encoding):
    octree = fuse(scenes["plane"], encoding, (16, 40, 24))
    checked = GridOctree(octree.trees, octree.data)
    assert checked.shape == (16, 40, 24)
    assert checked.channels == encoding.channels


def test_histograms_sum_to_one(scenes):
    octree = fuse_histogram(scenes["sphere"], 64)
    np.testing.assert_allclose(octree.data.sum(axis=1), 1, atol=1e-6)
    assert octree.data.min() >= 0


def test_the_tsdf_is_recovered_from_tdf_and_occupancy(scenes):
    signed = fuse_tsdf(scenes["sphere"], 64).to_dense()[0]
    distance, occupied = fuse_tdf_occupancy(scenes["sphere"], 64).to_dense()
    np.testing.assert_allclose((1 - 2 * occupied) * distance, signed, atol=3e-6)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_results_do_not_depend_on_the_number_of_threads(scenes, encoding):
    before = numba.get_num_threads()
    blobs = []
    try:
        for n_threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):
            numba.set_num_threads(n_threads)
            octree = fuse(scenes["box"], encoding, 64)
            blobs.append((octree.trees.tobytes(), octree.data.tobytes()))
    finally:
        numba.set_num_threads(before)
    assert len(set(blobs)) == 1


def test_what_is_no_views_is_refused(scenes):
    for fuse_it in (fuse_tsdf, DepthPyramid):
        with pytest.raises(OcnfError, match="not posed views"):
            fuse_it(scenes["plane"].depth, *[16] * (fuse_it is fuse_tsdf))


def test_a_shared_pyramid_gives_what_the_views_give(scenes):
    pyramid = DepthPyramid(scenes["plane"])
    for encoding in ENCODINGS:
        for resolution in (16, 40):
            shared, alone = fuse(pyramid, encoding, resolution), fuse(scenes["plane"], encoding, resolution)
            assert np.array_equal(shared.trees, alone.trees)
            np.testing.assert_array_equal(shared.data, alone.data)


def test_the_default_truncation_is_the_papers():
    for resolution, metres in ((64, 0.1), (128, 0.05), (256, 0.025), (512, 0.0125)):
        assert default_truncation(resolution) == pytest.approx(metres, rel=1e-12)
    assert default_truncation(256, extent=6.0) == pytest.approx(0.05, rel=1e-12)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"resolution": 100}, "resolution"), ({"resolution": 0}, "resolution"),
        ({"resolution": -8}, "resolution"),
        ({"resolution": 1032}, "resolution"), ({"resolution": (64, 64)}, "resolution"),
        ({"resolution": 64.0}, "resolution"), ({"resolution": "64"}, "resolution"),
        ({"resolution": (64, 64, 60)}, "resolution"), ({"extent": 0.0}, "extent"),
        ({"extent": float("nan")}, "extent"), ({"truncation": -0.1}, "truncation"),
        ({"truncation": float("inf")}, "truncation"), ({"centre": (0.0, 0.0)}, "centre"),
        ({"centre": (0.0, float("nan"), 0.0)}, "centre"), ({"centre": "abc"}, "centre"),
        ({"centre": 0.0}, "centre"), ({"extent": "3"}, "extent"), ({"truncation": [0.1]}, "truncation"),
    ],
)  # fmt: skip
def test_bad_arguments_are_named(scenes, arguments, field):
    with pytest.raises(OcnfError) as error:
        fuse_tsdf(scenes["box"], **{"resolution": 64, **arguments})
    assert error.value.field == field


def test_an_unknown_encoding_is_named(scenes):
    with pytest.raises(OcnfError, match="encoding: no such encoding; found sdf, expected occupancy or tsdf"):
        fuse(scenes["box"], "sdf", 64)


def test_a_bad_threshold_is_named(scenes):
    with pytest.raises(OcnfError) as error:
        fuse_occupancy(scenes["box"], 64, threshold=0.0)
    assert error.value.field == "threshold"
