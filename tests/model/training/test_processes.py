"""Real processes: runs that are killed and resumed, two ranks under gloo."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model.checkpoint import load_run
from ocnf_model.training.run import train
from ocnf_model.training.train_state import load_state

ENVIRONMENT = {**{name: value for name, value in os.environ.items() if name not in ("RANK", "WORLD_SIZE")},
               "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}

# Dies at batch number `last` of this process, between forward and backward pass.
TRAINS_UNTIL_KILLED = """
import os, signal, sys
from ocnf_model.training import objective
from ocnf_model.cli import main

left = int(sys.argv.pop(1))
l1_loss = objective.LOSSES["l1"]

def counted(*arguments, **named):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return l1_loss(*arguments, **named)

objective.LOSSES["l1"] = counted
main()
"""


def test_a_run_killed_in_the_middle_of_epochs_ends_with_the_same_weights(tiny, small, tmp_path) -> None:
    stages = [{"epochs": 2, "batch_size": 1, "accumulate": 2, "learning_rate": 1e-3}]
    settings = small(stages=stages, save_every=1, augment="flips")
    train(tiny, tmp_path / "whole", settings, device="cpu")

    file, out = tmp_path / "settings.json", tmp_path / "killed"
    file.write_text(json.dumps(settings.to_dict()))
    # Five batches an epoch, a step and a state after the second, the fourth and the fifth.
    for workers, last, place_then in ((1, 9, (0, 1, 2)), (0, 8, (1, 0, 4))):
        process = subprocess.run(
            [sys.executable, "-c", TRAINS_UNTIL_KILLED, str(last), "train", tiny, "--out", str(out),
             "--settings", str(file), "--workers", str(workers), "--device", "cpu"],
            env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, timeout=120, check=False)
        assert process.returncode == -signal.SIGKILL, process.stderr
        place = load_state(out)[0]
        assert (place.level, place.epoch, place.step) == place_then
    train(tiny, out, settings.model_copy(update={"workers": 1}), device="cpu")
    place = load_state(out)[0]
    assert (place.level, place.epoch, place.step) == (1, 2, 0)
    for level in (1, 2):
        name = f"level-{level}.safetensors"
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    rows = [[(row.train_loss, row.val_mad, row.val_iou, row.steps) for row in load_state(folder)[0].rows]
            for folder in (out, tmp_path / "whole")]
    assert rows[0] == rows[1]
    assert not list(out.glob(".tmp-*")) and not (out / ".lock").exists()


def test_two_ranks_have_the_losses_of_one_with_twice_the_batch(tiny, small, tmp_path) -> None:
    stages = [{"epochs": 2, "batch_size": 2, "accumulate": 2, "learning_rate": 1e-3}]
    train(tiny, tmp_path / "one", small(stages=stages), device="cpu")

    stages[0]["batch_size"] = 1
    file, out = tmp_path / "settings.json", tmp_path / "two"
    file.write_text(json.dumps(small(stages=stages).to_dict()))
    process = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--local-addr", "127.0.0.1",
         "--nproc-per-node", "2", "-m", "ocnf_model.cli", "train", tiny, "--out", str(out), "--settings",
         str(file), "--device", "cpu"],
        env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, timeout=120, check=False)
    assert process.returncode == 0, process.stderr
    one, two = (load_state(folder)[0].rows for folder in (tmp_path / "one", out))
    assert [row.steps for row in one] == [row.steps for row in two] == [2, 4, 2, 4]
    for name in ("train_loss", "val_mad", "val_iou"):
        assert [getattr(row, name) for row in two] == pytest.approx([getattr(row, name) for row in one], 1e-3)
    first, second = (load_run(folder).state_dict() for folder in (tmp_path / "one", out))
    for name, tensor in first.items():
        torch.testing.assert_close(second[name], tensor, rtol=1e-3, atol=1e-4)
    # The samples of its second level are dealt out to two, and how many it takes is said; nothing is written.
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    stages = [*stages, {**stages[0], "epochs": 3}]
    with pytest.raises(OcnfError, match=r"processes: .*found 1, expected 2. .*torchrun --nproc-per-node 2"):
        train(tiny, out, small(stages=stages), device="cpu")
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
