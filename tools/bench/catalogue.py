"""Opening a data set of 1,000 to 1,000,000 samples, with its catalogue and with one index a shard.

    python tools/bench/catalogue.py [--samples 1000 10000 ...] [--latency 0.05] [--indices 100000]

The data sets are simulated: 16 samples a shard, 7 members a sample; there are no tars, which opening does not
touch. "Remote" is an HTTP server on this machine that lets every request wait. Each opening is a process of
its own: `ShardDataset(...)`, from call to return. Memory is what Python and numpy allocated for it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from noisy_octrees import print_table

from ocnf_data.encodings import Encoding
from ocnf_data.files.storage import Store
from ocnf_data.shards import Counts, DatasetInfo, FileEntry, ShardEntry, write_dataset
from ocnf_data.shards.catalogue import Keys, ShardContents, SplitCatalogue
from ocnf_data.shards.index import (
    Member,
    SampleEntry,
    ShardIndex,
    catalogue_path,
    index_path,
    shard_name,
)
from ocnf_data.shards.tarformat import BLOCK, JSON, TRAILER, input_member, stored_size, target_member

SPLIT = "train"
RESOLUTIONS = (64, 128, 256)
VARIANT = "v4_n02"
PER_SHARD = 16
CATEGORIES = ("airplane", "bed", "chair", "table")
MEMBERS = (JSON, *map(target_member, RESOLUTIONS),
           *(input_member(VARIANT, Encoding.HISTOGRAM, resolution) for resolution in RESOLUTIONS))


def main() -> None:
    """Print the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("--samples", type=int, nargs="+", default=[10**3, 10**4, 10**5, 10**6])
    parser.add_argument("--latency", type=float, default=0.05, help="seconds that a request waits")
    parser.add_argument("--indices", type=int, default=10**5, metavar="N",
                        help="up to how many samples the data set without a catalogue is opened too")
    parser.add_argument("--open", metavar="URL", help=argparse.SUPPRESS)
    parser.add_argument("--trace", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.open:
        print(json.dumps(open_dataset(options.open, options.trace)))
        return
    rows = []
    for n_samples in options.samples:
        for listed in (True, False):
            if listed or n_samples <= options.indices:
                rows.append(measure(n_samples, listed, options.latency))
    print(f"### opening a data set; remote: {1e3 * options.latency:.0f} ms a request\n")
    print_table("samples | shards | read from | MB read | local, s | remote, s | requests | bytes a sample, "
                "held | at most", rows)


def measure(n_samples: int, listed: bool, latency: float) -> list[str]:
    """A row: with the catalogue, or with the indices alone."""
    with tempfile.TemporaryDirectory() as folder:
        simulate(Path(folder), n_samples, catalogue=listed, indices=not listed)
        local = run(folder)
        traced = run(folder, "--trace")
        with slow_server(Path(folder), latency) as server:
            remote = run(server.url)
    return [f"{n_samples:,}", f"{-(-n_samples // PER_SHARD):,}", "catalogue" if listed else "indices",
            f"{server.sent / 1e6:.1f}", f"{local['seconds']:.2f}", f"{remote['seconds']:.2f}",
            f"{server.requests:,}", f"{traced['held'] / n_samples:.0f}", f"{traced['peak'] / n_samples:.0f}"]


def run(url: str, *options: str) -> dict[str, float]:
    """Open a data set in a process of its own."""
    command = [sys.executable, __file__, "--open", url, *options]
    found: dict[str, float] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    return found


def open_dataset(url: str, trace: bool) -> dict[str, float]:
    """Seconds, and bytes held and at most held."""
    import tracemalloc

    from ocnf_data import ShardDataset

    if trace:
        tracemalloc.start()
    begin = time.perf_counter()
    dataset = ShardDataset(url, SPLIT, RESOLUTIONS, Encoding.HISTOGRAM)
    seconds = time.perf_counter() - begin
    assert dataset.variant == VARIANT
    held, peak = tracemalloc.get_traced_memory() if trace else (0, 0)
    return {"seconds": seconds, "held": held, "peak": peak}


def simulate(root: Path, n_samples: int, catalogue: bool, indices: bool) -> None:
    """Write `dataset.json` and the catalogue or the indices of a data set without its tars."""
    store = Store(root)
    (root / SPLIT).mkdir(parents=True, exist_ok=True)
    entries, contents = [], []
    for number, first in enumerate(range(0, n_samples, PER_SHARD)):
        count = min(PER_SHARD, n_samples - first)
        names = [f"{CATEGORIES[i % 4]}-{SPLIT}-{i:07d}" for i in range(first, first + count)]
        if indices:
            index = simulated_index(number, names)
            blob = index.to_json()
            (root / index_path(SPLIT, index.shard)).write_bytes(blob)
            entries.append(ShardEntry.of(index))
        else:
            digest = hashlib.sha256(str(number).encode()).hexdigest()
            entries.append(ShardEntry(shard=shard_name(number), size=10**7, sha256=digest,
                                      index_sha256=digest[::-1], samples=count))
            categories = tuple(name.partition("-")[0] for name in names)
            contents.append(ShardContents(Keys.of(names).text, categories, (MEMBERS,) * count))
    files = []
    if catalogue:
        data = SplitCatalogue.of(SPLIT, contents).to_bytes()
        (root / catalogue_path(SPLIT)).write_bytes(data)
        files.append(FileEntry.of(catalogue_path(SPLIT), data))
    counts = Counts(items=n_samples, samples=n_samples, failures=0, exclusions=0)
    write_dataset(store, DatasetInfo(name="simulated", manifest={}, fingerprint={}, counts=counts,
                                     splits={SPLIT: tuple(entries)}, files=tuple(files)))


def simulated_index(number: int, names: list[str]) -> ShardIndex:
    """The index of a shard with these keys."""
    samples, end = [], 0
    for name in names:
        members = []
        for member in MEMBERS:
            digest = hashlib.sha256(f"{name}.{member}".encode()).hexdigest()
            members.append(Member(name=member, offset=end + BLOCK, size=90_000, sha256=digest))
            end += stored_size(90_000)
        samples.append(SampleEntry(key=name, category=name.partition("-")[0], source=name,
                                   members=tuple(members), leaf_counts=dict.fromkeys(MEMBERS[1:], 50_000)))
    return ShardIndex(split=SPLIT, shard=shard_name(number), size=end + len(TRAILER), sha256="0" * 64,
                      samples=tuple(samples))


class SlowServer(ThreadingHTTPServer):
    """Serves a folder's files, whole or a range, on the loopback interface; counts what it is asked for."""

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, root: Path, latency: float) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.root, self.latency = root, latency
        self.requests = self.sent = 0
        self.lock = threading.Lock()

    @property
    def url(self) -> str:
        """`http://127.0.0.1:PORT/set`."""
        return f"http://127.0.0.1:{self.server_address[1]}/set"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: SlowServer

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, with_body: bool) -> None:
        time.sleep(self.server.latency)
        path = self.server.root / self.path.removeprefix("/set/")
        data = path.read_bytes() if path.is_file() else b""
        status, size = (200 if path.is_file() else 404), len(data)
        if status == 200 and (asked := self.headers.get("Range")) is not None:
            first, _, last = asked.removeprefix("bytes=").partition("-")
            data = data[int(first) : int(last) + 1 if last else None]
            status = 206 if data else 416
        self.send_response(status)
        self.send_header("Content-Length", str(len(data) if with_body else size))
        self.send_header("Accept-Ranges", "bytes")
        if status == 206:
            self.send_header("Content-Range", f"bytes {first}-{int(first) + len(data) - 1}/{size}")
        self.end_headers()
        if with_body:
            self.wfile.write(data)
        with self.server.lock:
            self.server.requests += 1
            self.server.sent += len(data) if with_body else 0

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""


@contextmanager
def slow_server(root: Path, latency: float) -> Iterator[SlowServer]:
    """A running server."""
    server = SlowServer(root, latency)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


if __name__ == "__main__":
    main()
