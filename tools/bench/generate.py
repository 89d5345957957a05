"""Meshes a minute from mesh file to written sample, by workers; memory a worker; time by stage; stored bytes.

    python tools/bench/generate.py [--meshes ROOT] [--items 60] [--jobs 1 2] [--resolutions 64 128 256]

80 views at 640x480, TSDF ground truth and one 4-view histogram variant at every resolution. One worker is one
thread, whatever their number. ROOT is laid out as ModelNet; without it, procedural shapes. A worker's memory
is that of its process and of the child process its items run in, together, sampled five times a second.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from ocnf_data.encodings import Encoding
from ocnf_data.generation.worker.memory import resident_bytes
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.shards.index import ShardIndex, index_path
from ocnf_data.shards.tarformat import JSON, parse_member

_SAMPLING_SECONDS = 0.2


class Run(NamedTuple):
    """One measured run: `memory` is (seconds, bytes of each worker with its child)."""

    jobs: int
    seconds: float
    items: int
    memory: list[tuple[float, list[int]]]

    @property
    def per_minute(self) -> float:
        """Items a minute, starting of processes included."""
        return 60 * self.items / self.seconds

    def peak(self, begin: float = 0.0, end: float = 1.0) -> float:
        """Megabytes of the largest worker in a part of the run."""
        part = [max(sizes) for at, sizes in self.memory
                if sizes and begin <= at / self.seconds <= end]
        return max(part, default=0) / 2**20


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ["OCNF_DATA"]) / "meshes" if "OCNF_DATA" in os.environ else None
    parser.add_argument("--meshes", type=Path, default=default)
    parser.add_argument("--items", type=int, default=60, help="about so many, as many of each category")
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--resolutions", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--backend", default="loky")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        manifest = base / "bench.yaml"
        manifest.write_text(json.dumps(_manifest(arguments.meshes, arguments.items, arguments.resolutions)))
        # Kernels that are not compiled yet would be compiled in the first run.
        _generate(manifest, base / "warm", arguments.meshes, 1, "loky", stop_after=1)
        runs = [_generate(manifest, base / f"jobs{jobs}", arguments.meshes, jobs, arguments.backend)
                for jobs in arguments.jobs]
        console = Console()
        console.print(_throughput(runs), _stages(base / f"jobs{runs[0].jobs}"),
                      _sizes(base / f"jobs{runs[0].jobs}"), sep="\n")


def _manifest(meshes: Path | None, items: int, resolutions: list[int]) -> dict[str, Any]:
    if meshes is None:
        source: dict[str, Any] = {"kind": "shapes", "categories": "all", "counts": {"train": items}}
    else:
        categories = sorted(path.name for path in meshes.iterdir() if (path / "train").is_dir())
        each = -(-items // len(categories))
        source = {"kind": "modelnet", "categories": categories, "counts": {"train": each}}
    return {"name": "bench", "source": source, "resolutions": resolutions, "shards": {"samples": 2},
            "inputs": [{"name": "v4_n02", "views": 4, "sigma": 0.02, "encodings": ["histogram"]}]}


def _generate(manifest: Path, out: Path, meshes: Path | None, jobs: int, backend: str,
              stop_after: int | None = None) -> Run:
    """Run the command and watch its processes; `stop_after` that many shards kills it."""
    command = [sys.executable, "-m", "ocnf_data", "generate", str(manifest), "--out", str(out), "--jobs",
               str(jobs), "--backend", backend, *(["--meshes", str(meshes)] if meshes else [])]
    begin = time.perf_counter()
    memory: list[tuple[float, list[int]]] = []
    with tempfile.TemporaryFile() as printed:
        process = subprocess.Popen(command, stdout=printed, stderr=subprocess.STDOUT)
        while process.poll() is None:
            time.sleep(_SAMPLING_SECONDS)
            memory.append((time.perf_counter() - begin, _workers(process.pid)))
            if stop_after is not None and len(list(out.glob("train/*.json"))) >= stop_after:
                process.kill()
                process.wait()
        seconds = time.perf_counter() - begin
        printed.seek(0)
        if process.returncode and stop_after is None:
            sys.exit(printed.read().decode())
    items = 0 if stop_after is not None else load_dataset(str(out)).counts.items
    return Run(jobs, seconds, items, memory)


def _workers(driver: int) -> list[int]:
    """Bytes of every worker below a process: each child process of ours with its parent."""
    parents, commands = {}, {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                commands[int(folder.name)] = (folder / "cmdline").read_bytes()
            except OSError:  # it has ended
                continue

    def below(pid: int) -> bool:
        return pid == driver or (pid in parents and pid > 1 and below(parents[pid]))

    found = []
    for pid, command in commands.items():
        if b"ocnf_data.generation.worker.child" in command and below(pid):
            try:
                found.append(resident_bytes(pid) + resident_bytes(parents[pid]))
            except OSError:
                continue
    return found


def _throughput(runs: list[Run]) -> Table:
    table = Table("workers", "items", "seconds", "items/min", f"x {runs[0].jobs} worker", "peak MB a worker",
                  "by quarter of the run", title="mesh file to written sample", title_justify="left")
    for run in runs:
        quarters = [f"{run.peak(i / 4, (i + 1) / 4):.0f}" for i in range(4)]
        table.add_row(str(run.jobs), str(run.items), f"{run.seconds:.1f}", f"{run.per_minute:.1f}",
                      f"{run.per_minute / runs[0].per_minute:.2f}", f"{run.peak():.0f}", " ".join(quarters))
    return table


def _stages(out: Path) -> Table:
    total: dict[str, float] = defaultdict(float)
    n = 0
    for path in out.glob("timings/*.json"):
        for timings in json.loads(path.read_bytes()).values():
            n += 1
            for stage, seconds in timings.items():
                total[stage] += seconds
    table = Table("stage", "ms a mesh", "%", title="one worker, by stage", title_justify="left")
    everything = sum(total.values())
    for stage, seconds in sorted(total.items(), key=lambda pair: -pair[1]):
        table.add_row(stage, f"{1e3 * seconds / n:.0f}", f"{100 * seconds / everything:.0f}")
    table.add_row("all", f"{1e3 * everything / n:.0f}", "100")
    return table


def _sizes(out: Path) -> Table:
    """Stored bytes beside those of the same octrees as `.oc` files."""
    stored: dict[str, int] = defaultdict(int)
    published: dict[str, int] = defaultdict(int)
    n = 0
    for split, entry in load_dataset(str(out)).shards():
        index = ShardIndex.from_json((out / index_path(split, entry.shard)).read_bytes(), out)
        for sample in index.samples:
            n += 1
            for member in sample.members:
                stored[member.name] += member.size
                if member.name != JSON:
                    published[member.name] += _oc_bytes(member.name, sample.leaf_counts[member.name])
    table = Table("member", "kB stored", "kB as .oc", "x smaller", title="a sample's members, on average",
                  title_justify="left")
    for name, size in (*stored.items(), ("all", sum(stored.values()))):
        oc = sum(published.values()) if name == "all" else published[name]
        ratio = f"{oc / size:.1f}" if oc else ""
        table.add_row(name, f"{size / n / 1e3:.0f}", f"{oc / n / 1e3:.0f}", ratio)
    return table


def _oc_bytes(member: str, leaves: int) -> int:
    """Size of an octree as `.oc`: 7 words; 16 bytes and a prefix word a tree; float32 a leaf and channel."""
    _, encoding, resolution = parse_member(member)
    channels = 1 if encoding is None else Encoding(encoding).channels
    return 28 + (16 + 4) * (resolution // 8) ** 3 + 4 * channels * leaves


if __name__ == "__main__":
    main()
