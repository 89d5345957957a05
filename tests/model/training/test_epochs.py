"""A run that is given other epochs goes on as if it had been begun with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import open_run
from ocnf_model.training.curves import Reporter
from ocnf_model.training.epochs import changed_epochs
from ocnf_model.training.run import train
from ocnf_model.training.train_state import load_state


def stage(epochs: int, **changes) -> dict:
    return {"epochs": epochs, "batch_size": 2, "accumulate": 2, "learning_rate": 1e-3, **changes}


def assert_one_run_is_the_other(ours: Path, theirs: Path) -> None:
    """States equal to the bit, and rows but for the time."""
    (first, expected), (second, found) = load_state(ours), load_state(theirs)
    assert expected.keys() == found.keys()
    assert all(torch.equal(tensor, found[name]) for name, tensor in expected.items())
    assert [(row.epoch, row.train_loss, row.val_mad, row.best) for row in first.rows] \
        == [(row.epoch, row.train_loss, row.val_mad, row.best) for row in second.rows]


def test_more_epochs_later_are_the_same_as_at_first(tiny, small, tmp_path) -> None:
    longer = small(levels=1, stages=[stage(3)])
    train(tiny, tmp_path / "once", longer, device="cpu")
    for epochs in (1, 3):
        train(tiny, tmp_path / "twice", small(levels=1, stages=[stage(epochs)]), device="cpu")
    assert_one_run_is_the_other(tmp_path / "once", tmp_path / "twice")
    fields = json.loads((tmp_path / "twice" / "settings.json").read_text())
    assert fields["extended"] == [{"level": 1, "epochs": 1, "raised_to": 3, "done": 1}]
    assert fields["settings"]["stages"][0]["epochs"] == 3
    before = (tmp_path / "twice" / "settings.json").read_bytes()
    train(tiny, tmp_path / "twice", longer, device="cpu")  # the same again raises nothing
    assert (tmp_path / "twice" / "settings.json").read_bytes() == before
    with pytest.raises(OcnfError, match=r"stages\[0\].epochs: fewer epochs than have begun.*at least 3"):
        train(tiny, tmp_path / "twice", small(levels=1, stages=[stage(2)]), device="cpu")
    assert (tmp_path / "twice" / "settings.json").read_bytes() == before


@pytest.mark.parametrize("epochs", [1, 2])
def test_fewer_epochs_later_are_the_same_as_at_first(tiny, small, tmp_path, monkeypatch, epochs) -> None:
    once = small(levels=1, stages=[stage(epochs)])
    train(tiny, tmp_path / "once", once, device="cpu")

    def stop(self: Any, *told: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Reporter, "epoch", stop)  # after the first epoch
        train(tiny, tmp_path / "ended", small(levels=1, stages=[stage(3)]), device="cpu")
    train(tiny, tmp_path / "ended", once, device="cpu")
    assert_one_run_is_the_other(tmp_path / "once", tmp_path / "ended")
    fields = json.loads((tmp_path / "ended" / "settings.json").read_text())
    assert fields["extended"] == [{"level": 1, "epochs": 3, "lowered_to": epochs, "done": 1}]


def test_the_last_level_may_go_on_and_one_that_others_build_on_may_not(tiny, small, out) -> None:
    train(tiny, out, small(stages=[stage(1), stage(1)]), device="cpu")
    first = (out / "level-1.safetensors").read_bytes()
    settings = (out / "settings.json").read_bytes()
    with pytest.raises(OcnfError, match=r"stages\[0\].epochs: the level is finished.*later levels only"):
        train(tiny, out, small(stages=[stage(2), stage(1)]), device="cpu")
    assert (out / "settings.json").read_bytes() == settings
    train(tiny, out, small(stages=[stage(1), stage(2)]), device="cpu")
    assert [(row.level, row.epoch) for row in load_state(out)[0].rows] == [(1, 1), (2, 1), (2, 2)]
    assert (out / "level-1.safetensors").read_bytes() == first
    assert open_run(out).resolutions == [32, 64]


def test_what_else_differs_is_another_run(small) -> None:
    one = small(stages=[stage(2)])
    assert changed_epochs(small(stages=[stage(2), stage(4)]), one) == {1: (2, 4)}
    assert changed_epochs(small(stages=[stage(3)]), one) == {0: (2, 3), 1: (2, 3)}
    assert changed_epochs(small(stages=[stage(3), stage(1)]), one) == {0: (2, 3), 1: (2, 1)}
    for other in (small(stages=[stage(3)], seed=1), small(stages=[stage(3, batch_size=1)]), one,
                  small(stages=[stage(3)], levels=1)):
        assert changed_epochs(other, one) == {}
    assert changed_epochs(small(stages=[stage(3)], workers=2), one)
