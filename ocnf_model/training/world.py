"""The processes that train together: one, or those that `torchrun` started.

    rank        this process among all of them
    local rank  this process among those of its machine: the number of its GPU, counted round
    world size  how many there are

Every rank has the same weights. A step averages the gradients over the ranks, so two ranks with batches of b
do what one does with batches of 2 b: the loader deals the samples of such a batch out to them. But for
`normalise: batch`, where each rank takes the mean and variance of its own samples.

Several ranks may share a GPU: the tables of a sample's structures are made by the CPU, and one process leaves
a large GPU idle meanwhile. Their gradients then go by way of the host, as NCCL wants a GPU for each rank.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Final

import torch
import torch.distributed as dist
from torch import Tensor

from ocnf_data.errors import OcnfError
from ocnf_model.devices import pick_device

_PATIENCE: Final = timedelta(hours=6)
"""How long a rank waits for the others. The first one makes a manifest's validation set or completion's
samples alone, and a rank's share of a large validation may take longer than the others': NCCL's 10 minutes
and gloo's 30 would end such a run. Of a rank that died torchrun tells the others at once."""


@dataclass(frozen=True)
class World:
    """This process's place, and its device."""

    device: torch.device
    rank: int = 0
    size: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this rank writes the files."""
        return self.rank == 0

    def average_gradients(self, parameters: Sequence[Tensor]) -> None:
        """Replace the gradients by their means over the ranks."""
        self.average(parameter.grad for parameter in parameters if parameter.grad is not None)

    def average(self, tensors: Iterable[Tensor]) -> None:
        """Replace floating point tensors by their means over the ranks; others are left as they are."""
        ours = [tensor for tensor in tensors if tensor.is_floating_point()]
        if self.size == 1 or not ours:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in ours])
        dist.all_reduce(flat)
        flat /= self.size
        for tensor, mean in zip(ours, flat.split([tensor.numel() for tensor in ours]), strict=True):
            tensor.copy_(mean.view_as(tensor))

    def sum(self, values: Sequence[float]) -> list[float]:
        """Sums over the ranks, in float64."""
        if self.size == 1:
            return list(values)
        total = torch.tensor(values, dtype=torch.float64, device=self.device)
        dist.all_reduce(total)
        sums: list[float] = total.tolist()
        return sums

    def wait(self) -> None:
        """Until all ranks are here."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def join_world(device: str) -> Iterator[World]:
    """Meet the other ranks, if `torchrun` started this process.

    Args:
        device: `auto`, `cpu`, `cuda`, or `cuda:1`.

    Raises:
        OcnfError: no such device, or the environment is only half that of a process that `torchrun` started.
    """
    size = _world_size()
    if size == 1 or dist.is_initialized():
        rank, size = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        yield World(pick_device(device), rank, size)
        return
    if device in ("auto", "cuda") and torch.cuda.is_available():
        device = f"cuda:{int(os.environ.get('LOCAL_RANK', '0')) % torch.cuda.device_count()}"
    chosen = pick_device(device)
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    dist.init_process_group(_backend(chosen), timeout=_PATIENCE)
    try:
        yield World(chosen, dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()


def _world_size() -> int:
    """How many processes train together by the environment, which has to say all or nothing of them."""
    text = os.environ.get("WORLD_SIZE", "").strip() or "1"
    if not (text.isascii() and text.isdigit() and int(text) > 0):
        raise OcnfError("not a number of processes", where="the environment", field="WORLD_SIZE", found=text,
                        expected="an integer, at least 1")
    if int(text) > 1 and not dist.is_initialized():
        for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"):
            if not os.environ.get(name):
                raise OcnfError(f"WORLD_SIZE is {text}, and the other variables of torchrun are not all set",
                                code="missing", where="the environment", field=name,
                                fix=f"start the processes with `torchrun --nproc-per-node {text} -m "
                                    "ocnf_model.cli train ...`, or unset WORLD_SIZE to train with one")
    return int(text)


def _backend(device: torch.device) -> str:
    """What the ranks talk by: NCCL where each has a GPU of its own."""
    n_here = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return "nccl" if device.type == "cuda" and n_here <= torch.cuda.device_count() else "gloo"
