"""Promise 11: an item that crashes or hangs its process costs a row, and nothing else."""

from __future__ import annotations

import mmap
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.generation.records import Failure, Item, Sample
from ocnf_data.generation.worker import pipe
from ocnf_data.generation.worker.memory import resident_bytes
from ocnf_data.generation.worker.supervisor import ChildLimits, ChildSetup, Supervisor

SLOW = 60.0


def item(deed: str, key: str = "k") -> Item:
    return Item(key, "train", "chair", f"chair/{deed}.off")


@pytest.fixture
def start(tmp_path: Path) -> Iterator[object]:
    started: list[Supervisor] = []

    def make(seconds: float = SLOW, resident: int = 700 * 2**20, maker: str = "maker") -> Supervisor:
        setup = ChildSetup({}, str(tmp_path), maker=f"fake_makers:{maker}")
        started.append(Supervisor(setup, ChildLimits(seconds, SLOW, resident)))
        return started[-1]

    yield make
    for supervisor in started:
        supervisor.close()


def test_one_child_serves_many_items(start) -> None:
    supervisor = start()
    results = [supervisor.run(item("ok", f"k{i}")) for i in range(20)]
    assert [r.key for r in results] == [f"k{i}" for i in range(20)]
    assert results[3].members["target-64.oct"] == b"k3" * 3000
    assert list(results[3].members) == ["json", "target-64.oct", "v1-tsdf-64.oct"]
    assert len({r.timings["pid"] for r in results}) == 1
    assert set(results[0].timings) == {"read", "render", "encode", "pid"}
    assert supervisor.n_started == 1


@pytest.mark.parametrize(("deed", "word"), [("segfault", "SIGSEGV"), ("exit", "status 0")])
def test_a_crash_is_tried_once_more_then_recorded(start, deed: str, word: str) -> None:
    supervisor = start()
    supervisor.run(item("ok"))
    failure = supervisor.run(item(deed))
    assert isinstance(failure, Failure)
    assert (failure.code, failure.stage, failure.item) == ("crash", "render", "k")
    assert word in failure.message
    assert supervisor.n_started == 2, "once in the old child, once alone in a fresh one"
    assert isinstance(supervisor.run(item("ok")), Sample)


@pytest.mark.parametrize("deed", ["hang", "deaf"])
def test_a_hanging_item_is_stopped(start, deed: str) -> None:
    supervisor = start(seconds=0.5)
    supervisor.run(item("ok"))
    begin = time.monotonic()
    failure = supervisor.run(item(deed))
    assert isinstance(failure, Failure)
    assert (failure.code, failure.stage) == ("timeout", "render")
    assert time.monotonic() - begin < SLOW / 2


@pytest.mark.parametrize("seconds", [1e9, 1e300])
def test_a_limit_that_is_none(start, seconds: float) -> None:
    """More milliseconds than the system's calls take: whoever wants no limit writes a large number."""
    assert isinstance(start(seconds=seconds).run(item("ok")), Sample)


def test_the_deadline_holds_over_several_waits(start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipe, "_LONGEST_POLL", 0.02)
    supervisor = start(seconds=0.5)
    assert isinstance(supervisor.run(item("slow")), Sample)
    failure = supervisor.run(item("hang"))
    assert isinstance(failure, Failure) and failure.code == "timeout"


def test_a_second_try_may_succeed(start) -> None:
    supervisor = start()
    assert isinstance(supervisor.run(item("segfault-once")), Sample)
    assert supervisor.n_started == 2


@pytest.mark.parametrize(("deed", "code", "message"), [
    ("refuse", "empty", "a.off: the mesh has no faces"),
    ("raise", "internal", "ZeroDivisionError: of all things"),
])
def test_an_exception_costs_a_row_and_not_the_child(start, deed: str, code: str, message: str) -> None:
    supervisor = start()
    failure = supervisor.run(item(deed))
    assert isinstance(failure, Failure)
    assert (failure.code, failure.stage) == (code, "render")
    assert failure.message.startswith(message)
    assert isinstance(supervisor.run(item("ok")), Sample)
    assert supervisor.n_started == 1


def test_trouble_of_the_machine_stops_the_run(start) -> None:
    with pytest.raises(OcnfError, match="disk is full") as caught:
        start().run(item("full"))
    assert caught.value.code == "disk_full"


def test_a_child_that_cannot_start_is_no_items_fault(start) -> None:
    with pytest.raises(OcnfError, match="a library is broken") as caught:
        start(maker="broken_maker").run(item("ok"))
    assert caught.value.code == "start"


def test_a_child_that_hoards_memory_is_replaced(start) -> None:
    supervisor = start(resident=150 * 2**20)
    assert isinstance(supervisor.run(item("hoard")), Sample)
    assert isinstance(supervisor.run(item("ok")), Sample)
    assert supervisor.n_started == 2


@pytest.mark.parametrize(("maker", "grows"), [("measured_maker", False), ("leaking_maker", True)])
def test_memory_stays_flat_over_many_meshes(meshes, define, maker: str, grows: bool) -> None:
    """Real samples in one child: half a megabyte kept of each item would show, and is seen where it is."""
    names = [f"m{i:02}" for i in range(48)]
    variant = {"name": "v4", "views": 4, "sigma": 0.02, "encodings": ["tsdf", "histogram"]}
    setup = ChildSetup(define(inputs=[variant]).to_dict(), str(meshes(names)), maker=f"fake_makers:{maker}")
    supervisor = Supervisor(setup, ChildLimits(item_seconds=300))  # the first item may compile
    results = [supervisor.run(Item(name, "train", "chair", f"chair/train/{name}.off")) for name in names]
    supervisor.close()
    assert len({result.timings["pid"] for result in results}) == 1
    resident = [result.timings["resident"] for result in results]
    # Caches fill with the first items. The 32 after these add less than 0.1 MB; the leak is 16 MB.
    growth = resident[-1] - resident[15]
    assert (growth > 4 * 2**20) == grows, f"{growth / 2**20:.1f} MB in 32 items"


def test_a_child_killed_while_idle_is_replaced_without_blame(start) -> None:
    supervisor = start()
    first = supervisor.run(item("ok"))
    os.kill(int(first.timings["pid"]), signal.SIGKILL)
    assert isinstance(supervisor.run(item("ok")), Sample)
    assert supervisor.n_started == 2


@pytest.mark.parametrize("deed", ["ok", "deaf"])
def test_the_child_dies_with_its_parent(tmp_path: Path, deed: str) -> None:
    """Also when it is deep in native code, and however hard the parent dies."""
    script = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})
from ocnf_data.generation.records import Item
from ocnf_data.generation.worker.supervisor import ChildSetup, ChildLimits, Supervisor
s = Supervisor(ChildSetup({{}}, maker="fake_makers:maker"), ChildLimits())
print(int(s.run(Item("k", "train", "chair", "ok")).timings["pid"]), flush=True)
s.run(Item("k", "train", "chair", {deed!r}))
import time; time.sleep(1000)
"""
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    time.sleep(0.3)
    parent.kill()
    parent.wait()
    parent.stdout.close()
    for _ in range(100):
        if not _running(child):
            return
        time.sleep(0.1)
    pytest.fail("the child outlived its parent")


def test_the_supervising_process_stays_small() -> None:
    """Workers import no numba, trimesh or torch: only their children do."""
    code = ("import sys, ocnf_data.generation.worker.supervisor; "
            "heavy = {'numba', 'trimesh', 'torch', 'numpy'}; "
            "sys.exit(', '.join(heavy & set(sys.modules)) or None)")
    subprocess.run([sys.executable, "-c", code], check=True)


def test_resident_bytes_sees_an_allocation() -> None:
    before = resident_bytes()
    with mmap.mmap(-1, 64 * 2**20) as ballast:  # new pages: the heap may hold what earlier tests freed
        for place in range(0, len(ballast), mmap.PAGESIZE):
            ballast[place] = 1
        assert resident_bytes() - before > 32 * 2**20


def _running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"
