"""A run that begins with the weights of another."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import checkpoint_path, load_run, save_checkpoint
from ocnf_model.header import parse_header
from ocnf_model.tensorfile import read_header
from ocnf_model.training.options import merge_options
from ocnf_model.training.run import train
from ocnf_model.training.schedule import Stage
from ocnf_model.training.stage import Trainer

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
        train(tiny, tmp_path / "back", small(blend=False, start=str(tmp_path / "blended")), device="cpu")


def test_a_share_that_does_not_learn_stays_and_the_rest_goes_on(tiny, small, tmp_path) -> None:
    stage = {"epochs": 2, "batch_size": 1, "accumulate": 1, "learning_rate": 1e-2}
    fields = {"levels": 1, "blend": True, "blend_from": 0.7, "average": 0.5}
    free = train(tiny, tmp_path / "free", small(**fields, stages=[stage]), device="cpu")
    fixed = {**fields, "blend_learns": False}
    whole = train(tiny, tmp_path / "whole", small(**fixed, stages=[stage]), device="cpu")
    first = {**stage, "epochs": 1}
    train(tiny, tmp_path / "parts", small(**fixed, stages=[first]), device="cpu")
    parts = train(tiny, tmp_path / "parts", small(**fixed, stages=[stage]), device="cpu")
    gate, learned = whole.levels[0].blend.gate, free.levels[0].blend.gate
    assert torch.equal(gate.weight, torch.zeros_like(gate.weight))
    assert torch.sigmoid(16 * gate.bias).item() == pytest.approx(0.7)
    assert learned.weight.abs().max() > 1e-4
    assert not torch.equal(whole.levels[0].head.weight, free.levels[0].head.weight)
    assert same(parts, whole)
    onwards = small(levels=1, blend=True, blend_learns=False, start=str(tmp_path / "free"))
    kept = train(tiny, tmp_path / "kept", onwards, device="cpu").levels[0]
    assert torch.equal(kept.blend.gate.weight, load_run(tmp_path / "free").levels[0].blend.gate.weight)
    assert not torch.equal(kept.head.weight, load_run(tmp_path / "free").levels[0].head.weight)


def test_a_first_share_is_refused_where_the_run_to_start_from_has_one(tiny, small, tmp_path) -> None:
    blended = small(levels=1, blend=True, stages=[STILL])
    train(tiny, tmp_path / "blended", blended, device="cpu")
    onwards = {"levels": 1, "stages": [STILL], "start": str(tmp_path / "blended"), "blend_from": 0.2}
    for more in ({}, {"blend": True}):  # named, or taken from there
        settings = merge_options(None, {**small(**onwards).model_dump(exclude_unset=True), **more}, {})
        message = r"blend_from: it would have no effect: .*blended has a blend, and keeps it; found 0.2"
        with pytest.raises(OcnfError, match=message):
            train(tiny, tmp_path / "run", settings, device="cpu")
    assert not (tmp_path / "run").exists()
    with pytest.MonkeyPatch.context() as patch:  # a run that an earlier version began goes on
        patch.setattr("ocnf_model.training.run.refuse_without_effect", lambda settings: None)
        train(tiny, tmp_path / "run", settings, device="cpu")
    train(tiny, tmp_path / "run", settings, device="cpu")


def test_the_first_level_may_be_given_context(tiny, small, tmp_path) -> None:
    plain = train(tiny, tmp_path / "plain", small(), device="cpu")
    settings = small(context=16, stages=[STILL], start=str(tmp_path / "plain"))
    wider = train(tiny, tmp_path / "wider", settings, device="cpu")
    assert same(wider, plain)
    assert wider.levels[0].context.out.weight.abs().max() < 1e-6
    with pytest.raises(OcnfError, match=r"context: .*found 16, expected 0"):
        train(tiny, tmp_path / "back", small(context=0, start=str(tmp_path / "wider")), device="cpu")


@pytest.mark.parametrize("more", [
    {"level_channels": [[4, 5, 4]]}, {"channels": [3, 4, 5]},
    {"level_channels": [[2, 3, 4]], "channels": [2, 3, 5]}], ids=str)
def test_levels_may_be_wider(more, tiny, small, make_batch, tmp_path) -> None:
    plain = train(tiny, tmp_path / "plain", small(blend=True), device="cpu")
    start = {"blend": True, "stages": [STILL], "start": str(tmp_path / "plain")}
    wider = train(tiny, tmp_path / "wider", small(**more, **start), device="cpu")
    inputs = [make_batch(level, (4 << level,) * 3, 2, 1, 0.3, torch.float32) for level in range(2)]
    with torch.no_grad():
        for ours, theirs in zip(wider(inputs), plain(inputs), strict=True):
            torch.testing.assert_close(ours.features, theirs.features, rtol=1e-4, atol=1e-5)
    loaded = load_run(tmp_path / "wider")
    assert [loaded.widths(level) for level in range(2)] == [wider.widths(level) for level in range(2)]
    assert [loaded.widths(level) for level in range(2)] != [plain.widths(level) for level in range(2)]
    narrow = {"channels": [2, 3, 4], "level_channels": None, "start": str(tmp_path / "wider")}
    with pytest.raises(OcnfError, match=r"channels: .*found .*, expected (null|\(2, 3, 4\))"):
        train(tiny, tmp_path / "back", small(blend=True, stages=[STILL], **narrow), device="cpu")
    bare = merge_options(None, {"start": str(tmp_path / "wider"), "levels": 2, "workers": 0},
                         {"epochs": "1", "learning_rate": "1e-30"})
    assert same(train(tiny, tmp_path / "again", bare, device="cpu"), load_run(tmp_path / "wider"))


def test_residual_levels_stay_as_wide_as_they_are(tiny, small, tmp_path) -> None:
    train(tiny, tmp_path / "residual", small(residual=True), device="cpu")  # which convolutions add their
    for widths in ({"level_channels": [[4, 5, 4]]}, {"channels": [2, 3, 5]}):  # input depends on the channels
        wider = small(residual=True, stages=[STILL], start=str(tmp_path / "residual"), **widths)
        with pytest.raises(OcnfError, match=r"channels: .*found (null|\(2, 3, 4\)), expected \("):
            train(tiny, tmp_path / "no", wider, device="cpu")


def test_channels_of_their_own_are_taken_over_for_as_many_levels_as_there_are(tiny, small, tmp_path) -> None:
    own = {"level_channels": [[3, 3, 4], [2, 4, 4]]}
    first = merge_options(None, {**small().model_dump(mode="json", exclude={"channels"}), **own}, {})
    begun = train(tiny, tmp_path / "own", first, device="cpu")
    again = merge_options(None, {"start": str(tmp_path / "own"), "levels": 1, "workers": 0},
                          {"epochs": "1", "learning_rate": "1e-30"})
    taken = train(tiny, tmp_path / "again", again, device="cpu")
    assert taken.level_channels == ((3, 3, 4),) and same(begun, taken)
    for more, message in (
            ({"levels": 2, "channels": [4, 6, 8]}, r"channels: it would have no effect: all levels have"),
            ({"level_channels": [[4, 4, 4]] * 2}, r"level_channels: it would .*there are 1 levels")):
        settings = merge_options(None, {**again.model_dump(exclude_unset=True), **more}, {})
        with pytest.raises(OcnfError, match=message):
            train(tiny, tmp_path / "no", settings, device="cpu")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("normalise", ["none", "batch"])
def test_levels_may_begin_to_read_what_is_finer(normalise, tiny, small, tmp_path) -> None:
    plain = train(tiny, tmp_path / "plain", small(normalise=normalise), device="cpu")
    settings = small(finer=1, normalise=normalise, stages=[STILL], start=str(tmp_path / "plain"))
    wider = train(tiny, tmp_path / "wider", settings, device="cpu")
    first, before = wider.levels[0].first[0].weight, plain.levels[0].first[0].weight
    assert first.shape[1] == 2 * before.shape[1]
    assert torch.equal(first[:, :before.shape[1]], before)
    assert first[:, before.shape[1]:].abs().max() < 1e-6  # counts for nothing yet
    assert all(torch.equal(value, plain.state_dict()[name]) for name, value in wider.state_dict().items()
               if name != "levels.0.first.0.weight" and "running" not in name and "num_batches" not in name)
    more = train(tiny, tmp_path / "more", small(finer=1, normalise=normalise, start=str(tmp_path / "wider")),
                 device="cpu")
    assert more.levels[0].first[0].weight[:, before.shape[1]:].abs().max() > 1e-6
    with pytest.raises(OcnfError, match=r"finer: .*found 1, expected 0"):
        train(tiny, tmp_path / "back", small(finer=0, normalise=normalise, start=str(tmp_path / "wider")),
              device="cpu")


def test_batch_normalisation_may_go(tiny, small, make_batch, tmp_path) -> None:
    normalised = train(tiny, tmp_path / "normalised", small(normalise="batch"), device="cpu")
    for level in normalised.levels:  # training this little leaves them near their beginning
        for part in level.modules():
            if isinstance(part, torch.nn.BatchNorm1d):
                part.running_mean.normal_()
                part.running_var.uniform_(0.2, 5)
                torch.nn.init.normal_(part.weight)
                torch.nn.init.normal_(part.bias)
    for number, level in enumerate(normalised.levels, 1):
        path = checkpoint_path(tmp_path / "normalised", number)
        header = parse_header(path, read_header(path))
        save_checkpoint(tmp_path / "normalised", header, level.state_dict())
    settings = small(normalise="none", stages=[STILL], start=str(tmp_path / "normalised"))
    folded = train(tiny, tmp_path / "folded", settings, device="cpu")
    assert not any(isinstance(part, torch.nn.BatchNorm1d) for part in folded.modules())
    inputs = [make_batch(level, (4 << level,) * 3, 2, normalised.in_channels, 0.3, torch.float32)
              for level in range(2)]
    with torch.no_grad():
        for ours, theirs in zip(folded(inputs), normalised.eval()(inputs), strict=True):
            torch.testing.assert_close(ours.to_dense(), theirs.to_dense(), rtol=1e-4, atol=1e-4)
    with pytest.raises(OcnfError, match=r"normalise: .*found none, expected batch"):
        train(tiny, tmp_path / "back", small(normalise="batch", start=str(tmp_path / "folded")), device="cpu")


def test_what_is_not_said_of_the_architecture_is_as_in_the_run_to_start_from(tiny, small, tmp_path) -> None:
    fields = {"channels": [2, 3, 5], "join": "add", "context": 16, "residual": True, "finer": 2}
    first = train(tiny, tmp_path / "first", small(**fields), device="cpu")
    bare = merge_options(None, {"start": str(tmp_path / "first"), "levels": 2, "workers": 0},
                         {"epochs": "1", "learning_rate": "1e-30"})
    second = train(tiny, tmp_path / "second", bare, device="cpu")
    assert same(second, first)
    header = read_header(checkpoint_path(tmp_path / "second", 1))
    assert header["settings"]["encoding"] == "tsdf" and header["settings"]["residual"] is True
    one = merge_options(None, {"start": str(tmp_path / "first"), "levels": 1, "workers": 0},
                        {"epochs": "1", "learning_rate": "1e-30"})
    third = train(tiny, tmp_path / "third", one, device="cpu")  # whose second level read ahead too
    assert third.finer == 1 and same(third.levels[0], first.levels[0])
    cut = merge_options(None, {"start": str(tmp_path / "first"), "levels": 2}, {})
    cut = cut.model_copy(update={"stages": (Stage(crop=64),)})
    with pytest.raises(OcnfError, match=r"settings as in .*first: stages\[0\].crop: .* needs the whole grid"):
        train(tiny, tmp_path / "cut", cut, device="cpu")


@pytest.fixture
def stopped_before_its_second_level(tiny, small, tmp_path, monkeypatch):
    """Settings and folder of a run that starts from another, whose second level has yet to begin."""
    train(tiny, tmp_path / "start", small(), device="cpu")
    settings = small(stages=[STILL], start=str(tmp_path / "start"))
    run = Trainer.run

    def stop(self: Trainer) -> None:
        if self._state.level == 1:
            raise KeyboardInterrupt
        run(self)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "run", stop)
        train(tiny, tmp_path / "run", settings, device="cpu")
    return settings, tmp_path / "run"


def test_levels_yet_to_begin_begin_with_the_weights_of_when_the_run_was(
        tiny, small, tmp_path, stopped_before_its_second_level) -> None:
    settings, run = stopped_before_its_second_level
    start = tmp_path / "start"
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    kept = (start / "level-2.safetensors").read_bytes()
    shutil.rmtree(start)
    train(tiny, start, small(seed=1), device="cpu")
    with pytest.raises(OcnfError, match=r"start, level 2: the run to start from has changed.*level-2.safe"):
        train(tiny, run, settings, device="cpu")
    (start / "level-2.safetensors").unlink()
    with pytest.raises(OcnfError, match=r"start, level 2: .*that is not there, expected with SHA-256"):
        train(tiny, run, settings, device="cpu")
    assert {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()} == before
    (start / "level-2.safetensors").write_bytes(kept)  # the first level is done: what it began with is past
    train(tiny, run, settings, device="cpu")
    shutil.rmtree(start)
    train(tiny, start, small(seed=1), device="cpu")
    again = {**STILL, "epochs": 2}
    train(tiny, run, small(stages=[STILL, again], start=str(start)), device="cpu")  # all levels have begun


def test_a_run_of_before_starts_were_recorded_goes_on(
        tiny, small, tmp_path, stopped_before_its_second_level) -> None:
    settings, run = stopped_before_its_second_level
    fields = json.loads((run / "settings.json").read_text())
    assert len(fields.pop("start")) == 2
    (run / "settings.json").write_text(json.dumps(fields))
    assert len(train(tiny, run, settings, device="cpu").levels) == 2


def test_another_network_is_refused_before_anything_is_written(tiny, small, tmp_path) -> None:
    train(tiny, tmp_path / "first", small(levels=1), device="cpu")
    with pytest.raises(OcnfError, match=r"level-1.safetensors.*channels: .*found"):
        train(tiny, tmp_path / "other", small(channels=[2, 2, 5], start=f"{tmp_path}/first"), device="cpu")
    assert not (tmp_path / "other" / "settings.json").exists()
    with pytest.raises(OcnfError, match="no such run"):
        train(tiny, tmp_path / "other", small(start=str(tmp_path / "nowhere")), device="cpu")
