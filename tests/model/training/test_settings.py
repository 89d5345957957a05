"""Settings: the paper's defaults, files and options over them, and what tells two runs apart."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import PRETRAINED, SHIPPED
from ocnf_model.cli import app
from ocnf_model.training.effects import refuse_without_effect
from ocnf_model.training.options import merge_options
from ocnf_model.training.run import train
from ocnf_model.training.settings import (
    Stage,
    TrainSettings,
    load_settings,
    read_settings,
    setting_difference,
)


def test_the_defaults_are_the_papers_schedule() -> None:
    settings = TrainSettings()
    assert [settings.stage(level).epochs for level in range(4)] == [50, 25, 25, 25]
    assert [stage.batch_size for stage in settings.stages] == [4, 1, 1]
    assert [stage.accumulate for stage in settings.stages] == [1, 4, 4]
    assert {(stage.learning_rate, stage.weight_decay) for stage in settings.stages} == {(1e-4, 1e-4)}
    assert (settings.levels, settings.join, settings.carry, settings.channels) \
        == (3, "concat", "features", (16, 32, 64))


def test_settings_survive_json() -> None:
    settings = TrainSettings(resolutions=(32, 64), variant="v2", categories=("chair",))
    assert read_settings(settings.to_dict(), "x") == settings


def test_options_go_before_the_file(tmp_path: Path) -> None:
    file = tmp_path / "s.yaml"
    file.write_text("levels: 2\nencoding: tsdf\nstages: [{epochs: 7, batch_size: 3}, {epochs: 5}]\n")
    settings = merge_options(file, {"encoding": "tdf_occupancy", "seed": None},
                             {"epochs": "9", "learning_rate": "1e-3,2e-3,3e-3", "decay": "none,cosine"},
                             "2,3,4")
    assert (settings.levels, settings.encoding, settings.channels) == (2, "tdf_occupancy", (2, 3, 4))
    assert [(s.epochs, s.batch_size, s.learning_rate) for s in settings.stages] \
        == [(9, 3, 1e-3), (9, 1, 2e-3), (9, 1, 3e-3)]
    assert [s.decay for s in settings.stages] == ["none", "cosine", "cosine"]


def test_cosine_decay_ends_at_zero_and_halves_on_the_way() -> None:
    stage = Stage(learning_rate=0.2, decay="cosine")
    assert [stage.rate(done, 4) for done in (0, 2, 4)] == pytest.approx([0.2, 0.1, 0.0])
    assert Stage(learning_rate=0.2).rate(3, 4) == 0.2


@pytest.mark.parametrize(("text", "message"), [
    ("level: 2", "level: unknown field"),
    ("levels: 0", "levels: the value is not allowed; found 0"),
    ("stages: []", "stages: the list is empty"),
    ("stages: [{epochs: 0}]", r"stages\[0\].epochs: the value is not allowed"),
    ("stages: [{rate: 1}]", r"stages\[0\].rate: unknown field"),
    ("resolutions: [64, 32]", "resolutions: not coarse to fine"),
    ("{levels: 2, finer: 3}", "finer: there are not as many levels; found 3, expected 0 to 2"),
    ("{encoding: occupancy, unseen: 0.5}",
     "unseen: this encoding does not tell what was measured; found 0.5, expected 1, or another encoding"),
    ("precision: float16", "precision: the value is not allowed; found 'float16', expected 'float32' or"),
    ("[1]", "not a mapping"),
])
def test_a_wrong_field_is_named(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text(text)
    with pytest.raises(OcnfError, match=f"settings.yaml: {message}"):
        merge_options(file, {}, {})


def test_the_next_resolution_is_read_where_there_is_one() -> None:
    settings = read_settings({"levels": 2, "finer": 2}, "test")
    there = {"resolutions": [64, 128, 256]}
    assert [settings.up_to(level, there) for level in (0, 1)] == [[64, 128], [64, 128, 256]]
    assert [settings.up_to(level, {"resolutions": [64, 128]}) for level in (0, 1)] == [[64, 128], [64, 128]]
    assert settings.own(1, there) == [128]


def test_a_list_that_is_none_is_named() -> None:
    with pytest.raises(OcnfError, match="epochs: not a list of numbers; found 'ten'"):
        merge_options(None, {}, {"epochs": "ten"})
    with pytest.raises(OcnfError, match=r"stages\[0\].epochs"):
        merge_options(None, {}, {"epochs": "1.5"})


def test_resolutions_that_cannot_be_pooled_twice_are_refused() -> None:
    """As the data set has them, before a run is begun."""
    for there in ([16, 32], [48, 96]):
        with pytest.raises(OcnfError, match=r"OUT: resolutions\[0\]: .* expected a multiple of 32"):
            TrainSettings(levels=2).resolved({"resolutions": there, "target": "tsdf"}, "v", "OUT")


def test_a_crop_larger_than_its_levels_grid_is_refused() -> None:
    there = {"resolutions": [64, 128], "target": "tsdf"}
    fits = read_settings({"levels": 2, "stages": [{}, {"crop": 128}]}, "x")
    assert fits.resolved(there, "v", "OUT").stage(1).crop == 128
    large = read_settings({"levels": 2, "stages": [{}, {"crop": 160}]}, "x")
    with pytest.raises(OcnfError, match=r"OUT: stages\[1\].crop: the crop is larger than the grid"):
        large.resolved(there, "v", "OUT")


def test_difference_names_the_field() -> None:
    ours = TrainSettings()
    assert setting_difference(ours, TrainSettings(workers=7, checkpointing=True, save_every=3)) is None
    assert setting_difference(ours, TrainSettings(seed=1)) == ("seed", 0, 1)
    stages = [stage.model_dump() for stage in ours.stages]
    stages[1]["learning_rate"] = 0.5
    found = setting_difference(ours, read_settings({"stages": stages}, "x"))
    assert found == ("stages[1].learning_rate", 1e-4, 0.5)
    assert setting_difference(ours, read_settings({"stages": stages[:1]}, "x"))[0] == "stages"


@pytest.mark.parametrize(("fields", "field"), [
    ({"output": "occupancy", "loss": "truncated_l1"}, "loss"),
    ({"output": "occupancy", "wrong_sign": 2.0}, "wrong_sign"),
    ({"output": "occupancy", "unseen": 0.5}, "unseen"),
    ({"blend_from": 0.5}, "blend_from"),
    ({"blend_learns": False}, "blend_learns"),
])
def test_what_would_have_no_effect_is_refused_before_anything_is_written(fields, field, tiny, small,
                                                                         tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match=f"the settings: {field}: it would have no effect"):
        train(tiny, tmp_path / "run", small(**fields), device="cpu")
    assert not (tmp_path / "run").exists()
    refuse_without_effect(read_settings({"blend": True, "output": "tsdf", field: fields[field]}, "test"))


def test_channels_that_no_data_set_has_are_refused(tiny, small, tmp_path: Path) -> None:
    message = "the settings: extra_channels: only the frames of completion have some"
    with pytest.raises(OcnfError, match=message) as caught:
        train(tiny, tmp_path / "run", small(extra_channels=1), device="cpu")
    assert (caught.value.found, caught.value.code) == ("1", "manifest")
    assert not (tmp_path / "run").exists()


def test_what_had_no_effect_in_a_run_of_before_lets_it_go_on(tiny, small, tmp_path: Path,
                                                             monkeypatch: pytest.MonkeyPatch) -> None:
    settings = small(levels=1, blend_from=0.5)
    with monkeypatch.context() as patch:
        patch.setattr("ocnf_model.training.run.refuse_without_effect", lambda settings: None)
        train(tiny, tmp_path / "run", settings, device="cpu")
    train(tiny, tmp_path / "run", settings, device="cpu")


@pytest.mark.parametrize("name", ["train.yaml", "scan/train.yaml"])
def test_the_settings_of_the_shipped_networks_have_an_effect(name: str) -> None:
    fields = load_settings(SHIPPED[PRETRAINED] / name)
    refuse_without_effect(read_settings({**fields, "output": "tsdf"}, name))


@pytest.mark.parametrize(("text", "arguments", "message"), [
    ("levels: 1", ["--epochs", "1,2,3"], "the command line: --epochs: .* is 1 level; found 3 entries, "),
    ("levels: 2", ["--learning-rate", "1,2,3"], "--learning-rate: .* there are 2 levels; found 3 entries, "),
    ("{levels: 1, stages: [{epochs: 1}, {epochs: 2}]}", [], r"s\.yaml: stages: .* found 2 entries"),
])
def test_what_is_said_for_more_levels_than_there_are_is_refused(text, arguments, message, tiny,
                                                                tmp_path: Path) -> None:
    file, out = tmp_path / "s.yaml", tmp_path / "run"
    file.write_text(text)
    result = CliRunner().invoke(app, ["train", tiny, "--out", str(out), "--settings", str(file), *arguments])
    assert isinstance(result.exception, OcnfError) and result.exception.code == "manifest"
    assert re.search(message, str(result.exception)), str(result.exception)
    assert not out.exists()


def test_a_file_may_have_stages_for_levels_that_the_command_line_leaves_out(tiny, tmp_path: Path) -> None:
    file, out = tmp_path / "s.yaml", tmp_path / "run"
    file.write_text("{levels: 2, encoding: tsdf, channels: [2, 2, 2], workers: 0, stages: "
                    "[{epochs: 1, batch_size: 1}, {epochs: 2}]}")
    begin = ["train", tiny, "--out", str(out), "--settings", str(file), "--device", "cpu", "--levels"]
    assert CliRunner().invoke(app, [*begin, "1"]).exit_code == 0
    file.write_text(file.read_text().replace("levels: 2", "levels: 1"))
    result = CliRunner().invoke(app, begin[:-1])  # a run that is begun is gone on with
    assert result.exit_code == 0, result.exception
