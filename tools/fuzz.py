"""Feed damaged bytes to everything that reads files: only `OcnfError` may come out.

    pip install atheris && python tools/fuzz.py [--seconds 60] [--only TARGET] [--findings DIR]

Each target runs in a process of its own for so many seconds, with coverage feedback, starting from small
valid files. Some wrap what the fuzzer makes in a valid frame or tar, so that it gets behind the checksums.
Prints how many inputs were tried, and how many of them were read as valid (mutations that change nothing
that is checked there: the SHA-256 in `dataset.json` is what catches those). An input that breaks something
is left in the folder of findings, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zstandard
from rich.console import Console
from rich.table import Table

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.meshes.formats import FORMATS
from ocnf_data.octree import TARGET, GridOctree
from ocnf_data.octree.codec import decode_raw, encode
from ocnf_data.shards.dataset import DatasetInfo
from ocnf_data.shards.index import ShardIndex, read_facts
from ocnf_data.shards.tarformat import BLOCK, make_header, parse_tar_header
from ocnf_data.shards.walk import index_from_tar

GOLDEN = Path(__file__).parent.parent / "tests" / "data" / "shards" / "golden-v1"
MAX_BYTES = 1 << 16
MEMORY_MB = 2048


def octrees() -> dict[str, bytes]:
    """A small valid blob of every kind."""
    rng = np.random.default_rng(0)
    volume = np.clip(rng.normal(0, 2, (1, 8, 8, 16)), -1, 1).astype(np.float32)
    histogram = rng.dirichlet(np.ones(10), (8, 8, 8)).astype(np.float32).transpose(3, 0, 1, 2).copy()
    occupied = (volume < 0).astype(np.float32)
    pair = np.concatenate([np.abs(volume), occupied])
    values = {TARGET: volume, Encoding.TSDF: volume, Encoding.OCCUPANCY: occupied,
              Encoding.TDF_OCCUPANCY: pair, Encoding.HISTOGRAM: histogram}
    return {str(kind): encode(GridOctree.from_dense(dense), kind) for kind, dense in values.items()}


def read_wrapped(content: bytes) -> None:
    """An octree whose content is arbitrary, in a valid frame."""
    decode_raw(zstandard.ZstdCompressor(write_checksum=True).compress(content))


def read_as_file(data: bytes) -> None:
    """A `.oc` file with these bytes."""
    file = os.memfd_create("fuzz")
    try:
        os.write(file, data)
        GridOctree.read_oc(f"/proc/self/fd/{file}")
    finally:
        os.close(file)


def read_tar(data: bytes) -> None:
    """A shard without its index."""
    index_from_tar(io.BytesIO(data), "train", "shard-000000.tar", "fuzz")


def read_member(payload: bytes) -> None:
    """A tar with one JSON member of these bytes, whole otherwise."""
    padded = payload + bytes(-len(payload) % BLOCK)
    read_tar(make_header("chair_0", "json", len(payload)) + padded + bytes(2 * BLOCK))


def mesh(suffix: str) -> Callable[[bytes], None]:
    """The parser of a mesh format."""
    return lambda data: void(FORMATS[suffix].parse(data, "fuzz", 100_000))


def void(_: object) -> None:
    """Drop a result."""


def targets() -> dict[str, tuple[Callable[[bytes], None], list[bytes]]]:
    """What reads, and valid files to start from."""
    blobs = octrees()
    unwrap = zstandard.ZstdDecompressor().decompress
    tar = (GOLDEN / "train" / "shard-000000.tar").read_bytes()
    index = (GOLDEN / "train" / "shard-000000.json").read_bytes()
    dataset = (GOLDEN / "dataset.json").read_bytes()
    facts_size = json.loads(index)["samples"][0]["members"][0]["size"]
    facts = tar[BLOCK : BLOCK + facts_size]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "small.oc")
        GridOctree.from_dense(np.zeros((1, 8, 8, 8), np.float32)).write_oc(path)
        published = path.read_bytes()
    triangle = {".off": b"OFF3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", ".stl": b"solid a\nfacet normal 0 0 1\n",
                ".obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1/1 -2//1 3\n",
                ".ply": b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
                        b"property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
                        b"end_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"}
    return {
        "octree blob": (lambda data: void(decode_raw(data)), list(blobs.values())),
        "octree content": (read_wrapped, [unwrap(blob) for blob in blobs.values()]),
        ".oc file": (read_as_file, [published]),
        "tar": (read_tar, [tar]),
        "tar header": (lambda data: void(parse_tar_header(data)), [tar[:BLOCK]]),
        "json member": (lambda data: void(read_facts(data, "fuzz")), [facts]),
        "json member in a tar": (read_member, [facts]),
        "index": (lambda data: void(ShardIndex.from_json(data, "fuzz")), [index]),
        "dataset.json": (lambda data: void(DatasetInfo.from_json(data, "fuzz")), [dataset]),
        **{f"mesh {suffix}": (mesh(suffix), [seed]) for suffix, seed in triangle.items()},
    }


def fuzz(name: str, seconds: float, findings: Path) -> None:
    """Fuzz one target in this process, which ends with it: the numbers go to standard output."""
    import atheris

    read, seeds = targets()[name]
    tried = accepted = 0
    end = time.monotonic() + seconds

    def once(data: bytes) -> None:
        nonlocal tried, accepted
        if time.monotonic() > end:
            print(json.dumps({"tried": tried, "accepted": accepted}), flush=True)
            os._exit(0)
        tried += 1
        try:
            read(data)
        except OcnfError:
            return
        accepted += 1

    corpus = Path(tempfile.mkdtemp())
    for i, seed in enumerate(seeds):
        (corpus / str(i)).write_bytes(seed)
    for module in [module for key, module in sys.modules.items() if key.startswith("ocnf_data")]:
        for function in [f for f in vars(module).values() if hasattr(f, "__code__")]:
            atheris.instrument_func(function)
    atheris.Setup([sys.argv[0], f"-max_len={MAX_BYTES}", f"-rss_limit_mb={MEMORY_MB}", "-timeout=20",
                   f"-artifact_prefix={findings}/", str(corpus)], once)
    atheris.Fuzz()


def main() -> None:
    """Fuzz every target, one process each, and print the table."""
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=plain)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--only", choices=targets())
    parser.add_argument("--findings", type=Path, default=Path("fuzz-findings"))
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.findings.mkdir(parents=True, exist_ok=True)
    if options.child:
        fuzz(options.only, options.seconds, options.findings)
    table = Table("target", "inputs tried", "read as valid", "")
    broken, total = 0, 0
    for name in [options.only] if options.only else targets():
        done = subprocess.run(
            [sys.executable, __file__, "--child", "--only", name, "--seconds", str(options.seconds),
             "--findings", str(options.findings)], capture_output=True, text=True, check=False)
        try:
            found = json.loads(done.stdout.splitlines()[-1])
        except (IndexError, ValueError):
            broken += 1
            log = options.findings / f"{name.replace(' ', '-')}.log"
            log.write_text(done.stdout + done.stderr)
            table.add_row(name, "", "", f"[red]broken, see {log}[/]")
            continue
        total += found["tried"]
        table.add_row(name, f"{found['tried']:,}", f"{found['accepted']:,}", "[green]only our error[/]")
    Console().print(table)
    Console().print(f"{total:,} inputs")
    if broken:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
