"""Which device and which way to talk a rank gets."""

from __future__ import annotations

from datetime import timedelta

import pytest
import torch

from ocnf_data.errors import OcnfError
from ocnf_model.training import world

TORCHRUN = {"WORLD_SIZE": "8", "RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}


@pytest.mark.parametrize(("local_rank", "n_here", "device", "backend"), [
    (0, 1, "cuda:0", "nccl"), (1, 2, "cuda:1", "nccl"), (5, 8, "cuda:1", "gloo"), (2, 3, "cuda:0", "gloo")])
def test_ranks_share_the_gpus_there_are(monkeypatch, local_rank: int, n_here: int, device: str,
                                        backend: str) -> None:
    """With two GPUs: one each as far as they go, then in turn, and by way of the host."""
    asked = {}
    for name, value in TORCHRUN.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("LOCAL_RANK", str(local_rank))
    monkeypatch.setenv("LOCAL_WORLD_SIZE", str(n_here))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: asked.update(device=str(device)))
    monkeypatch.setattr(world, "pick_device", torch.device)
    for name, found in (("init_process_group", lambda backend, timeout: asked.update(backend=backend,
                                                                                        timeout=timeout)),
                        ("get_rank", lambda: local_rank), ("get_world_size", lambda: 8),
                        ("destroy_process_group", lambda: None)):
        monkeypatch.setattr(world.dist, name, found)
    with world.join_world("auto") as joined:
        assert str(joined.device) == device
    assert timedelta(hours=1) <= asked.pop("timeout") <= timedelta(days=1)
    assert asked == {"device": device, "backend": backend}


def test_ranks_on_cpus_talk_by_gloo(monkeypatch) -> None:
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "1")
    assert world._backend(torch.device("cpu")) == "gloo"


@pytest.mark.parametrize(("changes", "message"), [
    ({"RANK": None}, "the environment: RANK: WORLD_SIZE is 8, .*torchrun --nproc-per-node 8"),
    ({"MASTER_ADDR": None}, "MASTER_ADDR: WORLD_SIZE is 8"),
    ({"MASTER_PORT": ""}, "MASTER_PORT: WORLD_SIZE is 8"),
    ({"WORLD_SIZE": "two"}, "WORLD_SIZE: not a number of processes; found two"),
    ({"WORLD_SIZE": "0"}, "WORLD_SIZE: not a number of processes; found 0"),
])
def test_half_an_environment_of_torchrun_is_refused(monkeypatch, changes: dict, message: str) -> None:
    for name, value in {**TORCHRUN, **changes}.items():
        monkeypatch.delenv(name, raising=False) if value is None else monkeypatch.setenv(name, value)
    with pytest.raises(OcnfError, match=message), world.join_world("cpu"):
        pass
