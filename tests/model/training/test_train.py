"""A run from beginning to end, and what stops one."""

from __future__ import annotations

import copy
import csv
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from ocnf_data import ShardDataset
from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import load_run, open_run
from ocnf_model.cli import app
from ocnf_model.metrics import mad_mm
from ocnf_model.network import OctNetFusion
from ocnf_model.training.batches import to_octree_batch
from ocnf_model.training.objective import LOSSES
from ocnf_model.training.run import train
from ocnf_model.training.train_state import load_state, save_state


def stage(**changes) -> dict:
    return {"epochs": 1, "batch_size": 2, "accumulate": 2, "learning_rate": 1e-3, **changes}


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.fixture(scope="module")
def finished(tiny, small, tmp_path_factory) -> Path:
    """A run of two levels with two epochs each."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    train(tiny, folder, small(stages=[stage(epochs=2)], best_by="mad"), device="cpu")
    return folder


def test_the_loss_falls_on_a_few_samples(tiny, small, out) -> None:
    settings = small(levels=1, channels=[6, 6, 6], train_split="val", categories=["chair"],
                     stages=[stage(epochs=60, batch_size=1, accumulate=1, learning_rate=1e-2)])
    train(tiny, out, settings, device="cpu")
    rows = load_state(out)[0].rows
    assert rows[-1].train_loss < 0.4 * rows[0].train_loss
    assert min(row.val_mad for row in rows) < 0.5 * rows[0].val_mad


def test_the_learning_rate_falls_over_all_epochs_of_a_level(tiny, small, out, monkeypatch) -> None:
    rates, step = [], torch.optim.Adam.step

    def noted(self, *args, **kwargs):
        rates.append(self.param_groups[0]["lr"])
        return step(self, *args, **kwargs)

    monkeypatch.setattr(torch.optim.Adam, "step", noted)
    # 5 samples in batches of 2, the last filled up, 2 batches a step: 2 steps an epoch, 4 in all.
    falling = stage(epochs=2, learning_rate=0.4, decay="cosine")
    train(tiny, out, small(levels=1, stages=[falling]), device="cpu")
    assert rates == pytest.approx([0.4, 0.2 * (1 + 0.5**0.5), 0.2, 0.2 * (1 - 0.5**0.5)])


def test_a_run_leaves_curves_and_checkpoints(finished) -> None:
    with (finished / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["level"], row["epoch"], row["resolution"]) for row in rows] \
        == [("1", "1", "32"), ("1", "2", "32"), ("2", "1", "64"), ("2", "2", "64")]
    # 5 samples in batches of 2, the last filled up, 2 batches a step: 2 steps an epoch.
    assert [row["steps"] for row in rows] == ["2", "4", "2", "4"]
    assert list((finished / "tensorboard").glob("level*/events*"))
    run = open_run(finished)
    assert run.resolutions == [32, 64]
    for level, header in enumerate(run.headers, 1):
        mads = [float(row["val_mad"]) for row in rows if row["level"] == str(level)]
        assert header.metrics["mad_mm"] == min(mads) and header.epoch == 1 + mads.index(min(mads))


def test_the_validation_mad_is_that_of_the_shipped_metric(finished, tiny) -> None:
    run = open_run(finished)
    mads = []
    for batch in ShardDataset(tiny, "val", [32, 64], "tsdf", uneven="exact"):
        inputs = [to_octree_batch(octrees) for octrees in batch.inputs.values()]
        with torch.no_grad():
            truth = to_octree_batch(batch.targets[64])
            mads += mad_mm(run.network(inputs)[1], truth, run.data.tau(64)).tolist()
    assert len(mads) == 2
    assert run.headers[1].metrics["mad_mm"] == pytest.approx(sum(mads) / 2, rel=1e-6)


def test_a_level_may_be_trained_and_validated_with_what_is_finer(tiny, small, out) -> None:
    train(tiny, out, small(finer=1, stages=[stage(epochs=2)], best_by="mad"), device="cpu")
    run = open_run(out)
    found: list[list[float]] = [[], []]
    for batch in ShardDataset(tiny, "val", [32, 64], "tsdf", uneven="exact"):
        inputs = [to_octree_batch(octrees) for octrees in batch.inputs.values()]
        for mads, made, resolution in zip(found, run.network(inputs), (32, 64), strict=True):
            truth = to_octree_batch(batch.targets[resolution])
            mads += mad_mm(made, truth, run.data.tau(resolution)).tolist()
    expected = [header.metrics["mad_mm"] for header in run.headers]
    assert [sum(mads) / 2 for mads in found] == pytest.approx(expected, rel=1e-6)
    assert run.network.levels[0].first[0].weight.shape[1] == 2 * run.network.in_channels


def test_a_finished_run_stays_as_it_is(finished, tiny, small) -> None:
    before = snapshot(finished)
    network = train(tiny, finished, small(stages=[stage(epochs=2)], best_by="mad", workers=1), device="cpu")
    after = snapshot(finished)
    assert {**after, "curves.csv": b""} == {**before, "curves.csv": b""}
    loaded = load_run(finished).state_dict()
    assert all(torch.equal(tensor, loaded[name]) for name, tensor in network.state_dict().items())


def test_settings_may_be_their_fields(tiny, small, out) -> None:
    fields = small(levels=1).model_dump(mode="json", exclude_unset=True)
    train(tiny, out, fields, device="cpu")
    train(tiny, out, small(levels=1), device="cpu")  # the same run, and done
    with pytest.raises(OcnfError, match="level: unknown field"):
        train(tiny, out, {"level": 1}, device="cpu")


def test_a_later_level_begins_where_the_one_before_was_best(finished, tiny, small, out, monkeypatch) -> None:
    begun = {}

    def record(network: OctNetFusion, level: int) -> list[str]:
        missing = start(network, level)
        begun.update(copy.deepcopy(network.levels[level].state_dict()))
        return missing

    start = OctNetFusion.start_from_previous
    monkeypatch.setattr(OctNetFusion, "start_from_previous", record)
    train(tiny, out, small(stages=[stage(epochs=2)], best_by="mad"), device="cpu")
    best = load_run(out).levels[0].state_dict()
    assert [name for name, tensor in begun.items() if not torch.equal(tensor, best.get(name, tensor[:0]))] \
        == ["first.0.weight"]
    assert (out / "level-1.safetensors").read_bytes() == (finished / "level-1.safetensors").read_bytes()


def test_occupancy_mixed_precision_and_checkpointing(tiny, small, out) -> None:
    settings = small(levels=1, output="occupancy", encoding="tdf_occupancy", precision="bfloat16",
                     checkpointing=True, join="add", carry="reconstruction", augment="rotations")
    train(tiny, out, settings, device="cpu")
    header = open_run(out).headers[0]
    assert 0 < header.metrics["mad"] < 1 and header.metrics["iou"] >= 0
    assert header.architecture.output == "occupancy"


def test_another_run_in_the_folder_is_refused(finished, tiny, small, tmp_path) -> None:
    before = snapshot(finished)
    for changes, field in (({"seed": 1}, "seed"), ({"levels": 1}, "levels"), ({"augment": "all"}, "augment"),
                           ({"stages": [stage(epochs=2, learning_rate=1)]}, r"stages\[0\].learning_rate")):
        with pytest.raises(OcnfError, match=f"{field}: the run was begun with other settings"):
            other = small(**{"stages": [stage(epochs=2)], "best_by": "mad", **changes})
            train(tiny, finished, other, device="cpu")
    assert snapshot(finished) == before
    for text, message in (("{", "not JSON"), ("{}", "not the settings"), ('{"schema": 1}', "not a mapping")):
        (tmp_path / "settings.json").write_text(text)
        with pytest.raises(OcnfError, match=f"settings.json: {message}"):
            train(tiny, tmp_path, small(), device="cpu")
    (tmp_path / "settings.json").unlink()
    (tmp_path / "letter.txt").write_text("Dear")
    with pytest.raises(OcnfError, match=r"not empty, and not a run; found letter.txt"):
        train(tiny, tmp_path, small(), device="cpu")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


@pytest.mark.parametrize(("changes", "message"), [
    ({"levels": 3}, "levels do not fit the resolutions; found 3, expected 2.*--levels 2"),
    ({"resolutions": [64, 128]}, "resolutions: the data set has no such octrees; found 128"),
    ({"encoding": "histogram"}, "encoding: the data set has no input of that encoding; found histogram"),
    ({"variant": "v9"}, "variant: the data set has no such octrees"),
    ({"val_split": "dev"}, "split: the data set has no such split; found dev, expected"),
    ({"val_split": "test"}, "split"),
    ({"categories": ["boat"]}, "no sample is of that category"),
])
def test_what_the_data_set_lacks_is_said_before_training(changes, message, tiny, small, out) -> None:
    with pytest.raises(OcnfError, match=message):
        train(tiny, out, small(**changes), device="cpu")
    assert not out.exists()


def test_a_device_that_is_not_there(tiny, small, out) -> None:
    with pytest.raises(OcnfError, match="device: no such device here; found tpu9"):
        train(tiny, out, small(), device="tpu9")


@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_what_is_not_finite_stops_the_run_and_names_the_samples(where, tiny, small, out, monkeypatch) -> None:
    calls = []
    l1_loss = LOSSES["l1"]

    def poisoned(*arguments, **named):
        losses = l1_loss(*arguments, **named)
        calls.append(len(losses))
        if len(calls) == 7:  # the first batch of the third epoch, its second sample
            poison = torch.tensor([0.0, float("nan")])
            losses = losses + poison if where == "loss" else losses * (losses * 0).sqrt()
        return losses

    monkeypatch.setitem(LOSSES, "l1", poisoned)
    settings = small(levels=1, stages=[stage(epochs=3, accumulate=1)], save_every=1)
    keys = next(batch.keys for batch in _epoch(tiny, 2))
    with pytest.raises(OcnfError, match=f"the {where} is not finite") as error:
        train(tiny, out, settings, device="cpu")
    expected = keys[1:] if where == "loss" else keys
    assert error.value.found == f"samples {', '.join(expected)}"
    place, tensors = load_state(out)
    assert (place.epoch, place.steps) == (2, 6) and open_run(out).headers[0].epoch <= 2
    assert all(tensor.isfinite().all() for tensor in tensors.values())
    monkeypatch.undo()
    train(tiny, out, settings, device="cpu")
    assert len(load_state(out)[0].rows) == 3


@pytest.mark.parametrize("seconds", [0.0, 3600.0])
def test_a_state_is_saved_where_the_last_is_too_old(seconds, tiny, small, out, monkeypatch) -> None:
    saved: list[tuple[int, int]] = []

    def noting(folder, state, *others):
        saved.append((state.epoch, state.steps))
        save_state(folder, state, *others)

    monkeypatch.setattr("ocnf_model.training.stage.save_state", noting)
    monkeypatch.setattr("ocnf_model.training.stage.SAVE_SECONDS", seconds)
    train(tiny, out, small(levels=1, stages=[stage(epochs=2, accumulate=1)], save_every=1000), device="cpu")
    ends = [(0, 3), (1, 3), (1, 6), (2, 6)]  # of training and of validation, three steps an epoch
    assert saved == (ends if seconds else sorted([*ends, (0, 1), (0, 2), (1, 4), (1, 5)]))


def _epoch(tiny, epoch):
    dataset = ShardDataset(tiny, "train", 32, "tsdf", batch_size=2)
    dataset.set_epoch(epoch)
    return dataset


def _starve_gpu(*_: object, **__: object) -> None:
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB")


def _starve_cpu(*_: object, **__: object) -> None:
    torch.empty(2**52, dtype=torch.uint8)


def _starve_python(*_: object, **__: object) -> None:
    np.empty(2**52, np.uint8)


@pytest.mark.parametrize("starve", [_starve_gpu, _starve_cpu, _starve_python])
def test_out_of_memory_says_what_to_lower(tiny, small, out, monkeypatch, starve) -> None:
    monkeypatch.setattr(OctNetFusion, "run", starve)
    with pytest.raises(OcnfError, match=r"level 1: out of memory.*batch_size \(now 2\).*--checkpointing"):
        train(tiny, out, small(), device="cpu")


def test_info_shows_layers_and_training(finished, tiny, small, out) -> None:
    result = CliRunner().invoke(app, ["info", str(finished)], env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    for text in ("levels.1.bottom.2", "16³", "6,986", "best checkpoints", "5 samples, 2 to validate"):
        assert text in result.output
    parameters = sum(parameter.numel() for parameter in load_run(finished).parameters())
    assert f"{parameters:,}" in result.output


def test_the_command_line_trains(tiny, out) -> None:
    arguments = ["train", tiny, "--out", str(out), "--levels", "1", "--encoding", "tsdf", "--epochs", "1",
                 "--channels", "2,2,2", "--workers", "0", "--device", "cpu"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert load_run(out).channels == (2, 2, 2)
    result = CliRunner().invoke(app, [*arguments, "--seed", "3"])
    assert isinstance(result.exception, OcnfError) and result.exception.field == "seed"


def test_a_damaged_sample_is_named_alike_with_and_without_workers(tiny, small, tmp_path) -> None:
    damaged = shutil.copytree(tiny, tmp_path / "set")
    for tar in (damaged / "train").glob("*.tar"):
        content = bytearray(tar.read_bytes())
        content[1024 + 4] ^= 1  # in the first payload
        tar.write_bytes(content)
    found = []
    for workers in (0, 1):
        settings = small(stages=[{"epochs": 1, "batch_size": 1, "accumulate": 1}], levels=1, workers=workers)
        with pytest.raises(OcnfError) as caught:
            train(str(damaged), tmp_path / f"run{workers}", settings, device="cpu")
        found.append(caught.value)
    alone, ours = found
    assert alone.code == "checksum" and alone.where.endswith(".tar") and alone.field
    assert vars(ours) == vars(alone) and str(ours) == str(alone)
