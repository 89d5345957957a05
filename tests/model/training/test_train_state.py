"""The state of a run: what is not what was written, or fits no run with these settings, is not trained on."""

from __future__ import annotations

import json
import random
import resource
from pathlib import Path
from typing import Any

import pytest
import safetensors
import safetensors.torch
import torch

from ocnf_data.errors import OcnfError
from ocnf_model.tensorfile import read_tensors, write_tensors
from ocnf_model.training.run import train
from ocnf_model.training.train_state import STATE, load_state

STAGES = [{"epochs": 3, "batch_size": 2, "accumulate": 2, "learning_rate": 1e-3}]


@pytest.fixture(scope="module")
def halfway(tiny, small, tmp_path_factory) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """The files of a run of one level that stopped after the second of three epochs, and those of its end."""
    folder = tmp_path_factory.mktemp("halfway") / "run"

    class StopError(Exception):
        pass

    def stop(self: Any, rows: Any, *told: Any) -> None:
        if len(rows) == 2:
            raise StopError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ocnf_model.training.curves.Reporter.epoch", stop)
        with pytest.raises(StopError):
            train(tiny, folder, small(levels=1, stages=STAGES), device="cpu")
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    train(tiny, folder, small(levels=1, stages=STAGES), device="cpu")
    return files, {path.name: path.read_bytes() for path in folder.glob("*.safetensors")}


@pytest.fixture
def run(halfway, out) -> Path:
    """The run that stopped, to be resumed."""
    out.mkdir()
    for name, blob in halfway[0].items():
        (out / name).write_bytes(blob)
    return out


def test_the_state_is_read_once_for_all_that_is_checked_and_done(halfway, run, tiny, small,
                                                                 monkeypatch) -> None:
    read = []

    def count(path: Path, **named: Any) -> Any:
        read.append(path.name)
        return read_tensors(path, **named)

    monkeypatch.setattr("ocnf_model.training.train_state.read_tensors", count)
    train(tiny, run, small(levels=1, stages=STAGES), device="cpu")
    assert read == [STATE]
    assert (run / "level-1.safetensors").read_bytes() == halfway[1]["level-1.safetensors"]


def rewrite(folder: Path, change: Any) -> None:
    """Let `change(tensors, header)` alter the state, and write it with a checksum that fits."""
    tensors, header = read_tensors(folder / STATE)
    change(tensors, header)
    write_tensors(folder / STATE, tensors, header)


def adam(name: str) -> str:
    return f"adam.{name}.bottom.1.weight"


@pytest.mark.parametrize(("change", "message"), [
    (lambda t, h: h.update(step="x"), "step: the value is not allowed; found 'x'"),
    (lambda t, h: h.update(step=1.0), "step: the value is not allowed"),
    (lambda t, h: h.update(epoch=10**9), "epoch: .* no run.*found 1000000000, expected at most 3"),
    (lambda t, h: h.update(epoch=10**400), "epoch: "),
    (lambda t, h: h.update(epoch=-1), "epoch: .*found -1"),
    (lambda t, h: h.update(epoch=1), "rows: the state is of no run.*found 2 epochs, expected those of 1"),
    (lambda t, h: h.update(level=1), "epoch: the state is of no run"),
    (lambda t, h: h.update(level=7), "level: .*at most 1"),
    (lambda t, h: h.update(step=9), "step: the state does not fit the data set.*expected at most 3"),
    (lambda t, h: h.update(step=2), "steps: the state does not fit"),
    (lambda t, h: h.update(steps=3), "steps: .*found 3, expected 4"),
    (lambda t, h: h.update(loss_sum=True), "loss_sum: "),
    (lambda t, h: h.update(loader=[1]), "loader: "),
    (lambda t, h: h.update(loader=None), "loader: the state does not fit"),
    (lambda t, h: h["loader"].update(step=1), "loader: the state does not fit"),
    (lambda t, h: h["loader"].update(epoch="x"), "loader: the state does not fit"),
    (lambda t, h: h["loader"].update(seed=1), "seed: the state is of a run with another order"),
    (lambda t, h: h["loader"].update(world_size=2), "processes: the level was begun by another number"),
    (lambda t, h: h["loader"].update(world_size="2"), "world_size: the state is of a run with another order"),
    (lambda t, h: h.update(rows={}), "rows: "),
    (lambda t, h: h.update(rows=h["rows"][::-1]), "rows: the state is of no run"),
    (lambda t, h: h["rows"][0].update(best=1), r"rows\[0\].best"),
    (lambda t, h: h["rows"][0].update(val_mad="0"), r"rows\[0\].val_mad"),
    (lambda t, h: h["rows"][0].update(resolution=64), "rows.resolution: .*found 64, expected 32"),
    (lambda t, h: h.update(extra=1), "extra: unknown field"),
    (lambda t, h: h.pop("steps"), "steps: the field is missing"),
    (lambda t, h: h.update(schema="1"), "another version"),
    (lambda t, h: t.update({adam("exp_avg"): torch.zeros(3)}), r"exp_avg.*found F32 \(3,\), expected F32"),
    (lambda t, h: t.update({adam("exp_avg"): t[adam("exp_avg")].double()}), "found F64"),
    (lambda t, h: t.pop(adam("exp_avg_sq")), "exp_avg_sq.*found nothing"),
    (lambda t, h: t.update({adam("step"): torch.zeros(2)}), "adam.step"),
    (lambda t, h: t.update({"weights.head.bias": torch.zeros(7)}), "head.bias"),
    (lambda t, h: t.update({"weights.extra": torch.zeros(7)}), "weights.extra.*expected nothing"),
    (lambda t, h: t.update({"random.cpu": torch.zeros(8, dtype=torch.uint8)}), "random.cpu"),
    (lambda t, h: t.pop("random.cpu"), "random.cpu"),
])  # fmt: skip
def test_a_state_that_fits_no_run_is_refused(change, message, run, tiny, small) -> None:
    rewrite(run, change)
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    with pytest.raises(OcnfError, match=message):
        train(tiny, run, small(levels=1, stages=STAGES), device="cpu")
    with pytest.raises(OcnfError):  # other epochs are only written down for a run that goes on
        train(tiny, run, small(levels=1, stages=[STAGES[0] | {"epochs": 4}]), device="cpu")
    after = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    assert after == before, "what is there stays, to be looked at"


def test_every_flipped_bit_is_found(run) -> None:
    path = run / STATE
    whole = path.read_bytes()
    chance = random.Random(0)
    header = 8 + int.from_bytes(whole[:8], "little")
    for at in (*range(8), *range(9, header, 13), *range(header, len(whole), 509), len(whole) - 1):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << chance.randrange(8)]) + whole[at + 1:])
        with pytest.raises(OcnfError, match=r"state\.safetensors"):
            load_state(run)


def test_a_state_of_before_checksums_is_resumed_with_a_note(run, halfway, tiny, small, caplog) -> None:
    tensors = safetensors.torch.load((run / STATE).read_bytes())
    with safetensors.safe_open(run / STATE, "pt") as file:
        header = json.loads(file.metadata()["ocnf"])
    del header["sha256"]
    (run / STATE).write_bytes(safetensors.torch.save(tensors, {"ocnf": json.dumps(header)}))
    train(tiny, run, small(levels=1, stages=STAGES), device="cpu")
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "state.safetensors is of a version that wrote no checksums" in caplog.text
    resumed = read_tensors(run / "level-1.safetensors")[0]
    (run / "level-1.safetensors").write_bytes(halfway[1]["level-1.safetensors"])
    uninterrupted = read_tensors(run / "level-1.safetensors")[0]
    assert all(torch.equal(tensor, uninterrupted[name]) for name, tensor in resumed.items())


def test_a_state_that_claims_much_takes_little(run, tiny, small) -> None:
    with (run / STATE).open("r+b") as file:
        file.truncate(2**42)  # sparse
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(OcnfError, match="too large for a checkpoint"):
        train(tiny, run, small(levels=1, stages=STAGES), device="cpu")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "kB"
