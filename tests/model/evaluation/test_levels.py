"""Levels run one by one: the network's own results, in the precision that it was trained in."""

from __future__ import annotations

import pytest
import torch

from ocnf_model import OctreeBatch, devices
from ocnf_model.checkpoint import checkpoint_sha256, open_run, save_checkpoint
from ocnf_model.devices import Precision
from ocnf_model.evaluation import levels
from ocnf_model.evaluation.levels import run_levels
from ocnf_model.header import Architecture, Header, TrainingData
from ocnf_model.network import OctNetFusion

CPU = torch.device("cpu")


def network(**settings) -> OctNetFusion:
    torch.manual_seed(0)
    return OctNetFusion("tsdf", levels=2, channels=(4, 8, 8), **settings).eval()


@pytest.fixture
def inputs(make_batch) -> list[OctreeBatch]:
    """One random octree at 32^3 and one at 64^3, of values in [-1, 1]."""
    batches = [make_batch(n, (4 * n,) * 3, 1, 1, 0.3) for n in (1, 2)]
    return [x.with_features(x.features.float().clamp(-1, 1)) for x in batches]


@pytest.mark.parametrize("settings", [{}, {"blend": True}, {"output": "occupancy"}])
def test_levels_one_by_one_are_those_of_the_network(settings, inputs, monkeypatch) -> None:
    made = network(**settings)
    for ours, theirs in zip(run_levels(made, inputs, CPU), made(inputs), strict=True):
        assert torch.equal(ours.reconstruction.features, theirs.features)
    made.precision = Precision.BFLOAT16
    monkeypatch.setattr(levels, "is_fast", lambda precision, device: True)
    first = next(iter(run_levels(made, inputs, CPU))).reconstruction.features
    exact = made(inputs[:1])[0].features
    assert first.dtype is torch.float32
    assert 0 < (first - exact).abs().max() < 0.05 * exact.abs().max()
    if settings != {"output": "occupancy"}:  # the head computes in float32
        assert not torch.equal(first, first.bfloat16().float())


def test_so_many_levels_run_as_are_asked_for(inputs) -> None:
    made = network(finer=1)
    assert len(list(run_levels(made, inputs, CPU))) == 2
    (one,) = run_levels(made, inputs, CPU, 1)
    assert torch.equal(one.reconstruction.features, made(inputs)[0].features)


def test_where_bfloat16_is_slow_it_is_not_used(inputs, monkeypatch) -> None:
    made = network()
    made.precision = Precision.BFLOAT16
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
    assert not devices.is_fast(Precision.BFLOAT16, CPU)
    for ours, theirs in zip(run_levels(made, inputs, CPU), made(inputs), strict=True):
        assert torch.equal(ours.reconstruction.features, theirs.features)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: True)
    assert devices.is_fast(Precision.BFLOAT16, CPU)
    assert devices.is_fast(Precision.FLOAT32, CPU)


@pytest.mark.parametrize(("trained_in", "expected"), [
    (({}, {}), "float32"), (({"precision": "bfloat16"},) * 2, "bfloat16"),
    (({"precision": "float32"}, {"precision": "bfloat16"}), "float32")])
def test_a_run_is_used_in_the_precision_of_its_training(trained_in, expected, tmp_path) -> None:
    made = network()
    data = TrainingData(name="d", checksum="0" * 64, variant="v2", n_train=3, n_val=2, extent=3.0,
                        truncation_voxels=2.0)
    for level, settings in enumerate(trained_in, 1):
        header = Header(level=level, resolution=16 << level, architecture=Architecture.of(made), data=data,
                        epoch=1, steps=4, metrics={}, settings=settings, torch="2",
                        built_on=checkpoint_sha256(tmp_path, 1) if level == 2 else None)
        save_checkpoint(tmp_path, header, made.levels[level - 1].state_dict())
    assert open_run(tmp_path).network.precision == expected
