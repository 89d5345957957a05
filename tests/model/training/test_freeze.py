"""Statistics of batch normalisation that stay from some epoch on."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model.network import OctNetFusion, freeze_statistics
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.training.curves import Reporter
from ocnf_model.training.run import train
from ocnf_model.training.train_state import load_state

STAGE = {"epochs": 3, "batch_size": 2, "accumulate": 2, "learning_rate": 1e-3}


def test_the_frozen_network_computes_what_it_does_in_use() -> None:
    torch.manual_seed(0)
    network = OctNetFusion("tsdf", 1, channels=(2, 3, 4), normalise="batch")
    volumes = [[OctreeBatch.full(torch.randn(2, 1, 32, 32, 32))] for _ in range(3)]
    for volume in volumes[:2]:
        network.train()(volume)  # gathers statistics
    (trained,) = network.train()(volumes[2])
    (used,) = network.eval()(volumes[2])
    assert not torch.allclose(trained.features, used.features, atol=1e-3)
    before = {name: buffer.clone() for name, buffer in network.named_buffers()}
    network.train()
    freeze_statistics(network)
    (frozen,) = network(volumes[2])
    torch.testing.assert_close(frozen.features, used.features)
    frozen.features.sum().backward()
    assert all(torch.equal(buffer, before[name]) for name, buffer in network.named_buffers())
    assert all(parameter.grad is not None for parameter in network.parameters())


def test_statistics_stay_from_the_named_epoch_on(tiny, small, out, monkeypatch) -> None:
    seen = []

    def note(self: Any, rows: Any, *told: Any) -> None:
        tensors = load_state(out)[1]
        seen.append({name: tensor.clone() for name, tensor in tensors.items() if name.startswith("weights.")})

    monkeypatch.setattr(Reporter, "epoch", note)
    train(tiny, out, small(levels=1, normalise="batch", stages=[STAGE | {"freeze_after": 1}]), device="cpu")
    running = [name for name in seen[0] if "running" in name]
    assert running and len(seen) == 3
    assert all(torch.equal(seen[0][name], seen[2][name]) for name in running)
    assert not all(torch.equal(seen[0][name], seen[2][name]) for name in seen[0])  # the weights went on


def test_there_has_to_be_something_to_freeze(small) -> None:
    with pytest.raises(OcnfError, match=r"stages\[0\].freeze_after: there are no statistics to keep"):
        small(stages=[STAGE | {"freeze_after": 1}])
