"""A run that begins with the weights of another."""

from __future__ import annotations

import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import load_run
from ocnf_model.training.run import train

STILL = {"epochs": 1, "batch_size": 2, "accumulate": 2, "learning_rate": 1e-30, "weight_decay": 0}
"""A rate so small that the weights stay where they begin."""


def same(ours: torch.nn.Module, theirs: torch.nn.Module, but: tuple[str, ...] = ()) -> bool:
    first, second = ours.state_dict(), theirs.state_dict()
    return all(torch.equal(first[name].cpu(), second[name].cpu()) for name in second if name not in but)


def test_every_level_begins_with_the_weights_of_its_like(tiny, small, tmp_path) -> None:
    train(tiny, tmp_path / "first", small(levels=1, seed=3), device="cpu")
    train(tiny, tmp_path / "second", small(stages=[STILL], start=str(tmp_path / "first")), device="cpu")
    first, second = load_run(tmp_path / "first"), load_run(tmp_path / "second")
    assert same(second.levels[0], first.levels[0])
    assert same(second.levels[1], first.levels[0], but=("first.0.weight",))  # which the other run lacks
    third = train(tiny, tmp_path / "third", small(start=str(tmp_path / "second")), device="cpu")
    assert not same(third.levels[0], second.levels[0])  # goes on from there
    still = small(stages=[STILL], start=str(tmp_path / "third"))
    fourth = train(tiny, tmp_path / "fourth", still, device="cpu")
    assert same(fourth, third)


def test_a_blend_may_be_added_to_a_network_without(tiny, small, tmp_path) -> None:
    train(tiny, tmp_path / "plain", small(), device="cpu")
    start = {"stages": [STILL], "start": str(tmp_path / "plain"), "blend_from": 0.8}
    blended = train(tiny, tmp_path / "blended", small(blend=True, **start), device="cpu")
    plain = load_run(tmp_path / "plain")
    assert same(blended, plain)  # all that the plain one has
    assert blended.levels[0].blend is not None
    for level in blended.levels:
        assert level.blend.gate.weight.abs().max() < 1e-6
        assert torch.sigmoid(16 * level.blend.gate.bias).item() == pytest.approx(0.8)
    again = small(blend=True, start=str(tmp_path / "blended"))
    more = train(tiny, tmp_path / "again", again, device="cpu")
    still = small(blend=True, stages=[STILL], start=str(tmp_path / "again"))
    assert same(train(tiny, tmp_path / "still", still, device="cpu"), more)
    assert more.levels[0].blend.gate.weight.abs().max() > 1e-6
    with pytest.raises(OcnfError, match=r"blend: .*found True, expected False"):
        train(tiny, tmp_path / "back", small(start=str(tmp_path / "blended")), device="cpu")


def test_another_network_is_refused_before_anything_is_written(tiny, small, tmp_path) -> None:
    train(tiny, tmp_path / "first", small(levels=1), device="cpu")
    with pytest.raises(OcnfError, match=r"level-1.safetensors.*channels: .*found"):
        train(tiny, tmp_path / "other", small(channels=[2, 3, 5], start=f"{tmp_path}/first"), device="cpu")
    assert not (tmp_path / "other" / "settings.json").exists()
    with pytest.raises(OcnfError, match="no such run"):
        train(tiny, tmp_path / "other", small(start=str(tmp_path / "nowhere")), device="cpu")
