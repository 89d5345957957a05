"""Real processes: two ranks under gloo, runs that are killed and resumed, memory over many epochs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from torch.utils.data import DataLoader

from ocnf_data import ShardDataset

ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in ("RANK", "WORLD_SIZE")}

TWO_RANKS = """
import json, sys
import torch, torch.distributed as dist
from torch.utils.data import DataLoader
from ocnf_data import ShardDataset

url, rank, rendezvous = sys.argv[1], int(sys.argv[2]), sys.argv[3]
dist.init_process_group("gloo", init_method=f"file://{rendezvous}", rank=rank, world_size=2)
dataset = ShardDataset(url, "train", 16, "histogram", batch_size=2)
loader = DataLoader(dataset, batch_size=None, num_workers=rank + 1)
met = []
for _ in range(2):
    for batch in loader:
        total = torch.ones(1)
        dist.all_reduce(total)          # hangs, or fails, unless both ranks have as many batches
        met.append([batch.epoch, batch.step, batch.keys, batch.repeat])
        assert total.item() == 2
gathered = [None, None]
dist.all_gather_object(gathered, met)
dist.destroy_process_group()
if rank == 0:
    print(json.dumps(gathered))
"""

READS_ON = """
import json, sys, time
from torch.utils.data import DataLoader
from ocnf_data import ShardDataset

url, log, workers = sys.argv[1], sys.argv[2], int(sys.argv[3])
dataset = ShardDataset(url, "train", 16, "histogram", uneven="exact", rank=0, world_size=1)
with open(log, "a+") as file:
    file.seek(0)
    lines = file.read().splitlines()
    if lines:
        dataset.load_state_dict(json.loads(lines[-1])["state"])
    for batch in DataLoader(dataset, batch_size=None, num_workers=workers):
        file.write(json.dumps({"keys": batch.keys, "state": dataset.state_dict(batch)}) + "\\n")
        file.flush()
        time.sleep(0.05)
"""


COMPILES_NOTHING = """
import sys
from numba.core.registry import CPUDispatcher
from ocnf_data import ShardDataset

batches = list(ShardDataset(sys.argv[1], "train", [16, 32], "histogram", augment="all"))
kernels = {kernel for name, module in list(sys.modules.items()) if name.startswith("ocnf_data")
           for kernel in vars(module).values() if isinstance(kernel, CPUDispatcher)}
assert sum(sum(kernel.stats.cache_hits.values()) for kernel in kernels) > 3
assert not sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels)
"""


def start(script: str, *arguments: object) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-W", "ignore", "-c", script, *map(str, arguments)],
                            env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)


def test_a_new_process_compiles_nothing(eleven):
    """Kernels come from numba's cache, so a spawned worker delivers after its imports."""
    list(ShardDataset(eleven, "train", [16, 32], "histogram", augment="all"))
    assert start(COMPILES_NOTHING, eleven).wait(timeout=120) == 0


def test_two_ranks_on_an_odd_number_of_shards(eleven, tmp_path):
    ranks = [start(TWO_RANKS, eleven, rank, tmp_path / "rendezvous") for rank in range(2)]
    try:
        output = [rank.communicate(timeout=120)[0] for rank in ranks]
    finally:
        for rank in ranks:
            rank.kill()
    assert [rank.returncode for rank in ranks] == [0, 0]
    by_rank = json.loads(output[0])
    places = [[epoch, step] for epoch in range(2) for step in range(3)]
    assert [[batch[:2] for batch in met] for met in by_rank] == [places, places]
    for epoch in range(2):
        first = [(key, again) for step in range(3) for met in by_rank
                 for key, again in zip(*met[3 * epoch + step][2:], strict=True)]
        assert [again for _, again in first] == [False] * 11 + [True]
        assert sorted(key for key, _ in first[:11]) == [f"s{number:03d}" for number in range(11)]
        assert first[11][0] == first[0][0]


def test_a_run_killed_twice_and_resumed_meets_every_sample_once(eleven, tmp_path):
    log = tmp_path / "log"
    log.touch()
    for workers, lines_before_the_kill in ((2, 3), (3, 7), (1, None)):
        process = start(READS_ON, eleven, log, workers)
        try:
            deadline = time.monotonic() + 120
            while lines_before_the_kill and len(log.read_text().splitlines()) < lines_before_the_kill:
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.005)
            if lines_before_the_kill:
                process.send_signal(signal.SIGKILL)
            status = process.wait(timeout=120)
        finally:
            process.kill()
        assert status == (-signal.SIGKILL if lines_before_the_kill else 0)
    keys = [key for line in log.read_text().splitlines() for key in json.loads(line)["keys"]]
    assert keys == [batch.keys[0] for batch in ShardDataset(eleven, "train", 16, "histogram", uneven="exact")]
    assert sorted(keys) == [f"s{number:03d}" for number in range(11)]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads /proc")
def test_memory_and_open_files_stay_flat_over_fifty_epochs(eleven):
    dataset = ShardDataset(eleven, "train", [16, 32], "histogram", batch_size=2, augment="all")
    loader = DataLoader(dataset, batch_size=None, num_workers=2, persistent_workers=True)
    sizes = {}
    bytes_read = 0
    for epoch in range(50):
        bytes_read += sum(batch.arena.nbytes for batch in loader)
        workers = [worker.pid for worker in loader._iterator._workers]
        sizes[epoch] = [footprint(process) for process in ("self", *workers)]
    assert bytes_read > 8e6  # so a process that kept what it saw, or half of it, would grow by more than 3 MB
    for (memory_then, files_then), (memory_now, files_now) in zip(sizes[9], sizes[49], strict=True):
        assert memory_now - memory_then < 2e6
        assert files_now <= files_then + 2


def footprint(process: int | str) -> tuple[int, int]:
    """(bytes of anonymous and of mapped shared memory, open files) of a process."""
    folder = Path(f"/proc/{process}")
    lines = (folder / "status").read_text().splitlines()
    memory = sum(1024 * int(line.split()[1]) for line in lines if line.startswith(("RssAnon", "RssShmem")))
    return memory, len(list((folder / "fd").iterdir()))
