"""Planning a data set of 1,000 to 1,000,000 items, and what of the plan a worker is sent.

    python tools/bench/plan.py [--items 1000 10000 ...]

Procedural shapes, 16 a shard. "Plan" lists, names, shuffles and cuts the items; "write" puts `plan.json` on
the disk. Each number of items is a process of its own, and its memory the most that the process held. Seconds
are those of the processor. A task is what a backend pickles for a worker: one shard's items and the manifest.
"""

from __future__ import annotations

import argparse
import json
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from noisy_octrees import print_table

from ocnf_data.files.storage import Store
from ocnf_data.generation.plan import make_plan
from ocnf_data.generation.resume import adopt
from ocnf_data.generation.shard_task import ShardTask
from ocnf_data.generation.worker.supervisor import ChildLimits, ChildSetup
from ocnf_data.manifest import Manifest


def main() -> None:
    """Print the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("--items", type=int, nargs="+", default=[10**3, 10**4, 10**5, 10**6])
    parser.add_argument("--plan", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.plan:
        print(json.dumps(plan(options.plan)))
        return
    rows = []
    for n_items in options.items:
        command = [sys.executable, __file__, "--plan", str(n_items)]
        rows.append([f"{n_items:,}", *json.loads(subprocess.check_output(command))])
    print("### planning\n")
    print_table("items | shards | plan, s | MB held | write, s | plan.json, MB | MB at most | a task, bytes",
                rows)


def plan(n_items: int) -> list[str]:
    """Plan in this process: the cells of a row."""
    manifest = Manifest.from_dict({
        "name": "planned", "source": {"kind": "shapes", "categories": ["bed", "chair", "lamp", "table"],
                                      "counts": {"train": n_items}},
        "resolutions": [64, 128, 256],
        "inputs": [{"name": "v4_n02", "views": 4, "sigma": 0.02, "encodings": ["histogram"]}],
        "shards": {"samples": 16}})
    begin = time.process_time()
    planned = make_plan(manifest, None)
    planning, held = time.process_time() - begin, megabytes()
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        adopt(Store(folder), planned)
        writing = time.process_time() - begin
        size = (Path(folder) / "plan.json").stat().st_size
    setup = ChildSetup(planned.manifest)
    task = max(len(pickle.dumps(ShardTask("out", shard, setup, ChildLimits())))
               for shard in planned.shards[:100])
    return [f"{len(planned.shards):,}", f"{planning:.2f}", f"{held:.0f}", f"{writing:.2f}",
            f"{size / 1e6:.1f}", f"{megabytes():.0f}", f"{task:,}"]


def megabytes() -> float:
    """The most that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


if __name__ == "__main__":
    main()
