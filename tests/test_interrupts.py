"""Ctrl-C and SIGTERM: every command says in one line what is kept and how to go on, and exits 130 or 143."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from ocnf_data import generate
from ocnf_data.manifest import Manifest

DRIVER = Path(__file__).with_name("interrupt_driver.py")
SIGNALS = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}
MANIFEST = {
    "name": "tiny",
    "source": {"kind": "shapes", "categories": ["chair", "lamp"], "counts": {"train": 6, "val": 2}},
    "camera": {"rig": "fibonacci8", "width": 48, "height": 40, "fx": 28, "fy": 27, "cx": 24, "cy": 20},
    "resolutions": [32],
    "inputs": [{"name": "v2", "views": 2, "sigma": 0.01, "encodings": ["tsdf", "histogram"]}],
    "shards": {"samples": 1},
}
TRAIN = ["--levels", "1", "--encoding", "tsdf", "--channels", "2,2,2", "--device", "cpu", "--epochs", "500"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six training samples and two to validate, each in a shard of its own."""
    folder = tmp_path_factory.mktemp("tiny") / "set"
    assert generate(Manifest.from_dict(MANIFEST), folder, progress=False).ok
    return folder


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with more samples than a test waits for."""
    path = tmp_path_factory.mktemp("manifest") / "tiny.yaml"
    many = {**MANIFEST["source"], "counts": {"train": 500, "val": 1}}  # type: ignore[dict-item]
    path.write_text(json.dumps({**MANIFEST, "source": many}))  # JSON is YAML
    return path


def start(command: list[str], **environment: str) -> subprocess.Popen[str]:
    """In a process group of its own, as a terminal's foreground job is."""
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                            start_new_session=True, env={**os.environ, **environment})


def stop(run: subprocess.Popen[str], number: int, progress: Callable[[], bool], to_all: bool) -> list[str]:
    """Wait for progress and send the signal, to the group as terminals do or to one; what stderr says."""
    try:
        while not progress():
            assert run.poll() is None, run.communicate()
            time.sleep(0.01)
        if to_all:
            os.killpg(run.pid, number)
        else:
            run.send_signal(number)
        _, errors = run.communicate(timeout=120)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
    assert run.returncode == STATUS[number], errors  # type: ignore[index]
    return errors.splitlines()


def children(pid: int) -> list[int]:
    """The processes that a process has started (Linux)."""
    with contextlib.suppress(OSError):
        return [int(child) for task in Path(f"/proc/{pid}/task").iterdir()
                for child in (task / "children").read_text().split()]
    return []


@SIGNALS
@pytest.mark.parametrize(("package", "place", "arguments", "sentence"), [
    ("ocnf_data", "ocnf_data.verify.verify:check_shard", ["verify", "DATA", "--jobs", "1"],
     "nothing was changed, and the same command starts again"),
    ("ocnf_data", "ocnf_data.verify.verify:check_shard", ["verify", "DATA", "--jobs", "2"],
     "nothing was changed, and the same command starts again"),
    ("ocnf_data", "ocnf_data.verify.verify:check_shard", ["repair", "DATA", "--jobs", "1"],
     "what was set aside is in DATA/quarantine, and the same command goes on"),
    ("ocnf_data", "ocnf_data.verify.summary:describe", ["info", "DATA"], "nothing was changed"),
    ("ocnf_data", "ocnf_data.doctor:run_doctor", ["doctor"], "nothing was changed"),
    ("ocnf_data", "ocnf_data.meshes.watertight:make_watertight",
     ["watertight", "MESHES", "OUT", "--jobs", "1"], "every mesh that is written is whole"),
    ("ocnf_data", "ocnf_data.generation.run:make_plan",
     ["generate", "MANIFEST", "--out", "OUT", "--jobs", "1"], "what is finished is kept, and the same"),
    ("ocnf_model", "ocnf_model.scan.run:read_scan", ["fuse", "pretrained", "SCAN", "--out", "OUT.ply"],
     "meshes are written at the end only"),
    ("ocnf_model", "ocnf_model.evaluation.run:Bench.run", ["evaluate", "pretrained", "DATA", "--split", "val",
     "--method", "volfus", "--out", "OUT"], "tables are written at the end only"),
    ("ocnf_model", "ocnf_model.evaluation.weights:_choose", ["choose-weight", "DATA", "--out", "OUT"],
     "OUT is written at the end only"),
    ("ocnf_model", "ocnf_model.info:open_run", ["info", "pretrained"], "nothing was changed"),
    ("ocnf_model", "ocnf_model.training.stage:Trainer._validate", ["train", "DATA", "--out", "OUT", *TRAIN],
     "the same command goes on in OUT"),
], ids=lambda value: value[0] if isinstance(value, list) else None)
def test_a_command_that_is_stopped_says_so_in_one_line(package, place, arguments, sentence, number, data,
                                                       manifest, tmp_path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/a.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    places = {"DATA": data, "OUT": tmp_path / "out", "OUT.ply": tmp_path / "out.ply", "MANIFEST": manifest,
              "MESHES": tmp_path / "meshes", "SCAN": tmp_path / "scan"}
    for name, path in places.items():
        arguments = [str(path) if part == name else part for part in arguments]
    sentence = sentence.replace("DATA/", f"{data}/").replace("OUT.ply", str(places["OUT.ply"]))
    sentence = sentence.replace("OUT", str(places["OUT"]))
    reached = tmp_path / "reached"
    run = start([sys.executable, str(DRIVER), package, place, *arguments], REACHED=str(reached))
    lines = stop(run, number, reached.exists, to_all=number == signal.SIGINT)
    assert len(lines) == 1, lines
    assert lines[0].startswith("stopped; ") and sentence in lines[0]


@SIGNALS
@pytest.mark.parametrize("moment", ["starting", "working"])
def test_generation_with_workers(number, moment, manifest, tmp_path) -> None:
    """While loky starts its processes, and in the midst of work; no process is left, and no traceback."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "ocnf_data", "generate", str(manifest), "--out", str(out), "--jobs", "2"]
    run = start(command)
    progress = (lambda: len(children(run.pid)) > 0) if moment == "starting" \
        else (lambda: any(out.glob("train/*.json")))
    lines = stop(run, number, progress, to_all=number == signal.SIGINT)
    assert len(lines) == 1, lines
    assert "the same command" in lines[0]


@SIGNALS
@pytest.mark.parametrize("command", ["verify", "watertight"])
def test_other_commands_while_their_workers_start(number, command, data, tmp_path) -> None:
    (tmp_path / "meshes").mkdir()
    for i in range(8):
        (tmp_path / f"meshes/{i}.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    arguments = [str(data)] if command == "verify" else [str(tmp_path / "meshes"), str(tmp_path / "out")]
    run = start([sys.executable, "-m", "ocnf_data", command, *arguments, "--jobs", "2"])
    lines = stop(run, number, lambda: len(children(run.pid)) > 0, to_all=number == signal.SIGINT)
    assert len(lines) == 1, lines
    assert lines[0].startswith("stopped; ")


@pytest.mark.parametrize(("number", "to_all"), [(signal.SIGINT, True), (signal.SIGTERM, False),
                                                (signal.SIGTERM, True)])
def test_training_with_a_loader_in_another_process(number, to_all, data, tmp_path) -> None:
    """After two epochs: their lines, then ours; nothing of leaked semaphores, or of loaders that are gone.

    Batch systems send SIGTERM to all processes of a job.
    """
    out = tmp_path / "run"
    command = [sys.executable, "-m", "ocnf_model.cli", "train", str(data), "--out", str(out), *TRAIN,
               "--workers", "1"]
    run = start(command, OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
    curves = out / "curves.csv"
    lines = stop(run, number, lambda: curves.exists() and curves.read_text().count("\n") > 2, to_all)
    text = " ".join(lines)
    assert lines[-1] == f"stopped; the same command goes on in {out}"
    assert not any(word in text for word in ("Traceback", "semaphore", "Error", "arning")), text


def test_what_loky_finds_left_behind_is_removed_in_silence() -> None:
    """A semaphore that the tracker believes to be there when all processes have ended, but is not."""
    code = """
import os
from joblib import Parallel, delayed
from joblib.externals.loky.backend import resource_tracker
from ocnf_data.files.interrupts import joblib_results
parallel = Parallel(2, return_as="generator_unordered")
with joblib_results(lambda: parallel(delayed(abs)(i) for i in (-1, 2))) as found:
    print(sorted(found), "PYTHONWARNINGS" in os.environ)
resource_tracker.register("/gone", "semlock")
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[1, 2] False\n"
    assert not run.stderr


def test_threads_that_are_startled_by_the_end_say_nothing() -> None:
    """As those of loky's are that watch workers while these are stopped."""
    code = """
import signal, sys, threading
from ocnf_data.files.interrupts import listen
listen()
stopped = threading.Event()
def watch():
    stopped.wait()
    raise RuntimeError("a worker is gone")
thread = threading.Thread(target=watch)
if sys.argv[1] == "early":
    stopped.set()
thread.start()
thread.join(0.2)
try:
    signal.raise_signal(signal.SIGTERM)
except KeyboardInterrupt:
    stopped.set()
    thread.join()
    print("stopped")
"""
    for moment, said in (("late", False), ("early", True)):  # before the signal an error is one
        run = subprocess.run([sys.executable, "-c", code, moment], capture_output=True, text=True, check=True)
        assert run.stdout == "stopped\n"
        assert ("a worker is gone" in run.stderr) == said
        assert said or not run.stderr


@SIGNALS
def test_an_interrupt_in_a_finaliser_is_not_lost(number) -> None:
    """Python prints and forgets what is raised in `__del__`; errors of other kinds are shown as ever."""
    code = """
import os, sys, time
from ocnf_data.files.interrupts import listen
listen()
listen()
class Finalised:
    def __init__(self, act):
        self.act = act
    def __del__(self):
        self.act()
        time.sleep(0.2)
def fail():
    raise ValueError("shown")
Finalised(fail)
try:
    Finalised(lambda: os.kill(os.getpid(), int(sys.argv[1])))
    time.sleep(10)
except KeyboardInterrupt:
    print("stopped")
"""
    began = time.monotonic()
    run = subprocess.run([sys.executable, "-c", code, str(int(number))], capture_output=True, text=True,
                         check=True)
    assert run.stdout == "stopped\n"
    assert time.monotonic() - began < 9
    assert "shown" in run.stderr and "KeyboardInterrupt" not in run.stderr
