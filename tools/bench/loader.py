"""Speed of the loader, beside other ways to store the same arrays; all in one run, medians.

    python tools/bench/loader.py [MESH | CATEGORY]

The sample is that of a training run: 4 views with 2 % noise as a histogram, TSDF of 80 views as target.
Without an argument, a procedural chair. Files are in the page cache.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numba
import numpy as np
import torch
import webdataset as wds
from noisy_octrees import print_table, sample_octrees
from torch.utils.data import DataLoader

from ocnf_data import GridOctree, ShardDataset
from ocnf_data.encodings import Encoding
from ocnf_data.files.records import sha256_hex
from ocnf_data.files.storage import Store
from ocnf_data.loading.assemble import Assembled
from ocnf_data.loading.batch import make_batch
from ocnf_data.loading.catalogue import Request, open_catalogue
from ocnf_data.loading.fetch import Fetcher
from ocnf_data.loading.order import epoch_order
from ocnf_data.octree import TARGET, RawOctree, decode_raw, encode
from ocnf_data.octree.symmetry import SYMMETRIES
from ocnf_data.shards import Counts, DatasetInfo, ShardWriter, write_dataset

RESOLUTIONS = (64, 128, 256)
KIND = str(Encoding.HISTOGRAM)
SAMPLES, SHARDS = 60, 5
COPIES = 12  # in the webdataset tars, which take long to write
ROUNDS = 15


def main() -> None:
    """Print the tables."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("mesh", nargs="?", default="chair")
    mesh = parser.parse_args().mesh
    octrees = sample_octrees(mesh, RESOLUTIONS)
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        blobs = write_set(root / "set", octrees)
        raw = decode_raw(blobs[f"v4-{KIND}-256.oct"])
        print(f"### {Path(mesh).stem}: one {KIND} at 256^3, {raw.n_leaves:,} leaves x {raw.channels}, "
              f"{raw.data.nbytes / 1e6:.1f} MB as {raw.data.dtype}; one process\n")
        formats_table(root, raw)
        print("### what one such sample costs, part by part; one process\n")
        parts_table(root, raw, blobs[f"v4-{KIND}-256.oct"])
        print("### whole training samples (input and target at 64, 128 and 256): DataLoader, batch_size 1\n")
        workers_table(root)


def write_set(root: Path, octrees: dict[tuple[str, int], GridOctree]) -> dict[str, bytes]:
    """A data set that holds the sample under several keys; returns the octree members."""
    blobs = {f"{name}-{resolution}.oct": encode(octrees[kind, resolution], kind)
             for name, kind in (("target", TARGET), (f"v4-{KIND}", KIND)) for resolution in RESOLUTIONS}
    leaf_counts = {f"{name}-{resolution}.oct": octrees[kind, resolution].n_leaves
                   for name, kind in (("target", TARGET), (f"v4-{KIND}", KIND)) for resolution in RESOLUTIONS}
    entries = []
    for shard in range(SHARDS):
        with ShardWriter(Store(root), "train", shard) as writer:
            for i in range(SAMPLES // SHARDS):
                key = f"s{shard}_{i}"
                facts = {"key": key, "category": "chair", "source": "bench", "leaf_counts": leaf_counts}
                writer.add(key, {"json": json.dumps(facts).encode(), **blobs})
        entries.append(writer.entry)
    counts = Counts(items=SAMPLES, samples=SAMPLES, failures=0, exclusions=0)
    write_dataset(Store(root), DatasetInfo(name="bench", manifest={}, fingerprint={}, counts=counts,
                                           splits={"train": tuple(entries)}))
    return blobs


def formats_table(root: Path, raw: RawOctree) -> None:
    """Time from the bytes of the tar (or the HDF5 file) to the arrays."""
    data = {"stored dtype": raw.data, "float32": raw.to_grid().data}
    trees = np.ascontiguousarray(raw.trees.view(np.uint8)[..., :10])
    sizes: dict[str, int] = {}
    loops: dict[str, Iterator[Any]] = {}
    fetcher = Fetcher(open_catalogue([str(root / "set")], request_of_one()))
    loops["ocnf, stored dtype, all checks"] = (fetcher.fetch(i % SAMPLES) for i in range(10**9))
    loops["ocnf, converted to float32"] = (fetcher.fetch(i % SAMPLES).octrees[f"v4-{KIND}-256.oct"].to_grid()
                                          for i in range(10**9))
    sizes |= dict.fromkeys(loops, len(encode(raw.to_grid(), KIND)))
    for name, values in data.items():
        label = f"webdataset, compressed .npz, {name}"
        tar = root / f"{name[:5]}.tar"
        with wds.TarWriter(str(tar)) as sink:
            for i in range(COPIES):
                sink.write({"__key__": f"s{i}", "npz": {"trees": trees, "data": values}})
        sizes[label] = tar.stat().st_size // COPIES
        loops[label] = npz_samples(tar)
        label = f"HDF5, gzip, {name}"
        with h5py.File(root / f"{name[:5]}.h5", "w") as file:
            file.create_dataset("trees", data=trees, compression="gzip")
            file.create_dataset("data", data=values, compression="gzip")
        sizes[label] = (root / f"{name[:5]}.h5").stat().st_size
        loops[label] = hdf5_samples(root / f"{name[:5]}.h5")
    times = race({name: lambda loop=loop: next(loop) for name, loop in loops.items()})  # type: ignore[misc]
    ours = times["ocnf, stored dtype, all checks"]
    print_table("format | MB | ms | ms / ours", [
        [name, f"{sizes[name] / 1e6:.2f}", f"{ms:.1f}", f"{ms / ours:.2f}"] for name, ms in times.items()])


def request_of_one() -> Request:
    """The 256^3 histogram alone."""
    return Request("train", (256,), Encoding.HISTOGRAM, "v4", categories=None, targets=())


def npz_samples(tar: Path) -> Iterator[Any]:
    """Arrays of the samples of a webdataset tar, round and round."""
    while True:
        for sample in wds.WebDataset(str(tar), shardshuffle=False).decode():
            yield sample["npz"]["trees"], sample["npz"]["data"]


def hdf5_samples(path: Path) -> Iterator[Any]:
    """Arrays of a file that stays open (its chunk cache holds less than one array)."""
    with h5py.File(path) as file:
        while True:
            yield file["trees"][()], file["data"][()]


def parts_table(root: Path, raw: RawOctree, blob: bytes) -> None:
    """What the loader does to a sample, and what of it can be left out."""
    request = request_of_one()
    fetcher = Fetcher(open_catalogue([str(root / "set")], request))
    sample = fetcher.fetch(0)
    plain = Assembled((sample,), (False,), (SYMMETRIES[0],), ())
    batch = make_batch(plain, request, 0, 0)

    def iterate(**options: Any) -> Callable[[], Any]:
        dataset = ShardDataset(root / "set", "train", 256, KIND, targets=False, **options)
        return round_and_round(dataset).__next__

    calls: dict[str, Callable[[], object]] = {
        "read, check and decode": lambda: fetcher.fetch(3),
        "  of it: SHA-256": lambda: sha256_hex(blob),
        "  of it: structure and values": lambda: RawOctree(raw.trees, raw.data, raw.kind),
        "pack into a batch": lambda: make_batch(plain, request, 0, 0),
        "  in shared memory, as workers do": lambda: into_shared_memory(batch.arena),
        "convert to float32": lambda: batch.inputs[256].to_float(),
        "augment: a rotation": lambda: sample.moved(SYMMETRIES[13]),
        "shuffle: the order of 1,000,000 samples": lambda: epoch_order([1000] * 1000, 0, 0, 1024),
        "an iteration, in order": iterate(shuffle=False),
        "an iteration, shuffled": iterate(),
        "an iteration, shuffled and augmented": iterate(augment="all"),
    }
    times = race(calls)
    whole = times["an iteration, shuffled"]
    shares = {name: f"{100 * ms / whole:.0f}" for name, ms in times.items() if "1,000,000" not in name}
    print_table("part | ms | % of an iteration", [
        [name, f"{ms:.2f}", shares.get(name, "")] for name, ms in times.items()])


def into_shared_memory(tensor: torch.Tensor) -> torch.Tensor:
    """A copy in new shared memory."""
    shared = torch.empty(0, dtype=tensor.dtype).set_(torch.UntypedStorage._new_shared(tensor.nbytes))
    return shared.copy_(tensor)


def workers_table(root: Path) -> None:
    """Samples a second for 0, 1 and 2 workers, taken in turns."""
    dataset = ShardDataset(root / "set", "train", RESOLUTIONS, KIND)
    loaders = {workers: DataLoader(dataset, None, num_workers=workers, persistent_workers=workers > 0)
               for workers in (0, 1, 2)}
    rates: dict[int, list[float]] = {workers: [] for workers in loaders}
    shared = {}
    for turn in range(4):
        for workers, loader in loaders.items():
            start = time.perf_counter()
            for batch in loader:
                shared[workers] = batch.arena.is_shared()
            if turn:  # the first starts the workers
                rates[workers].append(SAMPLES / (time.perf_counter() - start))
    medians = {workers: statistics.median(found) for workers, found in rates.items()}
    print_table("workers | samples/s | ratio to 1 worker | in shared memory", [
        [str(workers), f"{rate:.1f}", f"{rate / medians[1]:.2f}", str(shared[workers])]
        for workers, rate in medians.items()])


def round_and_round(dataset: Iterable[Any]) -> Iterator[Any]:
    """One epoch after the other."""
    while True:
        yield from dataset


def race(calls: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median milliseconds of each call; they take turns, so that all meet the same machine."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(ROUNDS + 2):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            if turn >= 2:
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(found) for name, found in times.items()}


if __name__ == "__main__":
    main()
