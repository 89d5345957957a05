"""Frames as octrees: padding, halving, masks, turning, and the way back to the scene's voxels."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_model.completion.data import UPRIGHT
from ocnf_model.completion.encoding import (
    CHANNELS,
    FREE_SPACE,
    UNKNOWN,
    coarser,
    coarser_targets,
    encode_view,
    targets,
)
from ocnf_model.completion.padding import padded, padded_shape
from ocnf_model.completion.sample import FrameSample, finer, grid_shape, load_sample, save_sample
from ocnf_model.completion.tabletop import Tabletop
from ocnf_model.completion.visible import LOWEST, Visible


@given(shape=st.tuples(*[st.integers(1, 30)] * 3), multiple=st.sampled_from([2, 8]))
def test_padding_keeps_the_corner_and_fills_the_rest(shape: tuple[int, int, int], multiple: int) -> None:
    volume = np.random.default_rng(0).random(shape).astype(np.float32)
    whole = padded(volume, padded_shape(shape, multiple), 7)
    assert all(n % multiple == 0 and 0 <= n - m < multiple for n, m in zip(whole.shape, shape, strict=True))
    depth, height, width = shape
    np.testing.assert_array_equal(whole[:depth, :height, :width], volume)
    assert (whole == 7).sum() == whole.size - volume.size


def test_targets_are_the_metric_s_truth_where_it_judges(tabletop: Callable[..., Tabletop]) -> None:
    scene = tabletop()
    unknown = scene.tsdf.copy()
    unknown[10:14, 10:20, 10:18] = np.nan
    scene = Tabletop("unknown", scene.view, scene.voxel, unknown)
    visible = Visible.of(scene.view, scene.shape, scene.voxel)
    found = targets(scene, visible)
    np.testing.assert_array_equal(found[visible.judged], scene.occupied[visible.judged])
    assert (found[:LOWEST] == UNKNOWN).all() and (found[~visible.in_image] == UNKNOWN).all()
    free = visible.free.copy()
    free[:LOWEST] = False
    assert (found[free] == 0).all()
    assert ((found == UNKNOWN) | free | visible.judged).all()
    assert (found[10:14, 10:20, 10:18][visible.judged[10:14, 10:20, 10:18]] == 1).all()


@given(seed=st.integers(0, 2**32))
def test_half_the_resolution_is_the_mean_of_what_is_known(seed: int) -> None:
    rng = np.random.default_rng(seed)
    volume = rng.choice([0, 1, UNKNOWN], (4, 6, 8)).astype(np.float32)
    found = coarser_targets(volume)
    for z, y, x in np.ndindex(found.shape):
        eight = volume[2 * z: 2 * z + 2, 2 * y: 2 * y + 2, 2 * x: 2 * x + 2]
        known = eight[eight != UNKNOWN]
        assert found[z, y, x] == pytest.approx(known.mean() if len(known) >= 4 else UNKNOWN)
    np.testing.assert_allclose(coarser(volume[None])[0, 1, 2, 3], volume[2:4, 4:6, 6:8].mean(), atol=1e-6)


def test_what_the_view_encodes(tabletop: Callable[..., Tabletop], inside: dict[str, np.ndarray]) -> None:
    scene = tabletop()
    visible = Visible.of(scene.view, scene.shape, scene.voxel)
    values = encode_view(scene, visible)
    assert values.shape == (CHANNELS, *scene.shape) and np.abs(values).max() <= 1
    free = visible.free.copy()
    free[:LOWEST] = False
    assert (values[:, free] == np.array(FREE_SPACE, np.float32)[:, None]).all()
    behind = visible.measured & (visible.behind > 0.03)
    behind[:LOWEST] = False
    assert (values[0, behind] == -1).all() and (values[1, behind] > 0.07).all()
    hidden = inside["box"] & ~visible.free
    assert (values[4, hidden] == 1).mean() > 0.9  # the top of the box is seen


def test_a_sample_is_the_padded_scene_at_each_resolution(tabletop: Callable[..., Tabletop],
                                                         tmp_path: Path) -> None:
    scene = tabletop()
    sample = FrameSample.of(scene)
    assert [octree.shape for octree in sample.inputs] == [(32, 64, 64), (64, 128, 128)]
    truth = sample.targets[1].to_dense()[0]
    visible = Visible.of(scene.view, scene.shape, scene.voxel)
    np.testing.assert_allclose(truth[:15, :20, :25], coarser_targets(targets(scene, visible)), atol=1e-6)
    assert (truth[15:] == UNKNOWN).all() and (truth[:, 20:] == UNKNOWN).all()
    assert (sample.inputs[1].to_dense()[:, 16:, 24:, 32:] == np.array(FREE_SPACE)[:, None, None, None]).all()
    save_sample(tmp_path / "a.npz", sample)
    kept = load_sample(tmp_path / "a.npz", "a", levels=1)
    assert len(kept.inputs) == 1
    np.testing.assert_allclose(kept.inputs[0].data, sample.inputs[0].data, atol=1e-3)


def test_a_kept_sample_that_is_damaged_is_said_to_be(tmp_path: Path) -> None:
    octree = GridOctree.from_dense(np.random.default_rng(0).random((1, 16, 16, 16)).astype(np.float32))
    file, chance = tmp_path / "a.npz", random.Random(0)
    save_sample(file, FrameSample("a", (octree, octree), (octree, octree)))
    whole = file.read_bytes()
    header = whole.index(b"descr")  # of the first array
    flipped = [*range(header, header + 100), *range(header + 100, whole.index(b"PK\3\4", header), 29)]
    flips = [whole[:at] + bytes([whole[at] ^ 1 << chance.randrange(8)]) + whole[at + 1:] for at in flipped]
    directory = whole.index(b"PK\1\2")
    encrypted, packed = (whole[:directory + at] + b"\x63" + whole[directory + at + 1:] for at in (8, 10))
    for data in (b"", b"PK", whole[:len(whole) // 2], whole[:-1], encrypted, packed, *flips):
        file.write_bytes(data)
        with pytest.raises(OcnfError, match=r"a\.npz: not a kept sample.*Delete it"):
            load_sample(file, "a")


def test_turning_leaves_up_where_it_is(tabletop: Callable[..., Tabletop]) -> None:
    sample = FrameSample.of(tabletop())
    layers = sample.targets[0].to_dense()[0].sum(axis=(1, 2))
    assert len(set(UPRIGHT)) == 8
    for symmetry in UPRIGHT:
        moved = sample.moved(symmetry)
        np.testing.assert_allclose(moved.targets[0].to_dense()[0].sum(axis=(1, 2)), layers, rtol=1e-5)
        assert moved.inputs[1].n_leaves == sample.inputs[1].n_leaves


@pytest.mark.parametrize("shrink", [2, 4])
def test_finer_is_exact_on_linear_volumes(shrink: int) -> None:
    shape, n = (13, 22, 9), 24 // shrink
    axes = np.indices((n, n, n)).astype(np.float32)
    coarse = (axes + 0.5) * shrink - 0.5  # the fine voxel's coordinate at each coarse centre
    found = finer(coarse[0] + 2 * coarse[1] - coarse[2], shape, shrink)
    fine = np.indices(shape)
    expected = (fine[0] + 2 * fine[1] - fine[2]).astype(np.float32)
    middle = tuple(slice(shrink, size - shrink) for size in shape)
    np.testing.assert_allclose(found[middle], expected[middle], atol=1e-4)


def test_a_scene_larger_than_the_network_s_grid_is_refused(tabletop: Callable[..., Tabletop]) -> None:
    scene = tabletop()
    with pytest.raises(OcnfError, match="larger than the network's grid"):
        grid_shape(Tabletop("large", scene.view, 0.005, np.zeros((80, 130, 257), np.float32)))
    assert grid_shape(Tabletop("flat", scene.view, 0.005, np.zeros((1, 2, 3), np.float32))) == (64, 128, 128)
