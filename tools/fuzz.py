"""Feed damaged bytes to everything that reads files: only `OcnfError` may come out.

    pip install atheris && python tools/fuzz.py [--seconds 60] [--only TARGET] [--findings DIR]

Each target runs in a process of its own for so many seconds, with coverage feedback, starting from small
valid files. Some wrap what the fuzzer makes in a valid frame, tar, GLB or checkpoint, so that it gets behind
the checksums; one makes folders of links and odd names out of it, and plans a data set from them.
Prints how many inputs were tried, and how many of them were read as valid (mutations that change nothing
that is checked there: the SHA-256 in `dataset.json` is what catches those). An input that breaks something
is left in the folder of findings, and the exit status is 1.
"""

from __future__ import annotations

import argparse
import atexit
import io
import json
import logging
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from rich.console import Console
from rich.table import Table

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.files.records import canonical_json
from ocnf_data.generation.plan import make_plan
from ocnf_data.generation.sample import read_item
from ocnf_data.manifest import Manifest
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


# ---- GLB files: what is used how often

TETRAHEDRON = b"".join(np.array(part, kind).tobytes() for part, kind in (
    ([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 4]], "<f4"), ([0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2], "<u2")))


def glb(text: bytes) -> bytes:
    """A GLB file with a tetrahedron's bytes and this JSON."""
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(TETRAHEDRON), 0x004E4942) + TETRAHEDRON
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def gltf_headers() -> list[bytes]:
    """A tetrahedron, the same with shared accessors and meshes, and on a chain of nodes."""
    primitive = {"attributes": {"POSITION": 0}, "indices": 1}
    plain: dict[str, Any] = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "translation": [1, 2, 3]}, {"mesh": 0, "scale": [2, 2, 2]}],
        "meshes": [{"primitives": [primitive]}], "buffers": [{"byteLength": len(TETRAHEDRON)}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"}]}
    shared = {**plain, "meshes": [{"primitives": [primitive] * 8}], "scenes": [{"nodes": [0, 1, 2]}],
              "nodes": [{"mesh": 0}] * 3}
    chain = {**plain, "nodes": [{"children": [i + 1], "mesh": 0, "rotation": [0, 0, 0, 1]} for i in range(5)]
             + [{"mesh": 0, "matrix": np.eye(4).ravel().tolist()}]}
    return [json.dumps(header).encode() for header in (plain, shared, chain)]


# ---- a folder of meshes: links, odd names, hidden files

NAMES = ["a.off", "b.off", ".c.off", "..off", os.fsdecode(b"d\xe9.off"), "e.stl", "f", "g.off"]
LINKS = ["a.off", "b.off", "g.off", "../f", ".", "..", "/dev/zero", "/etc/passwd", "nowhere", "f"]


def plan_folder(data: bytes) -> None:
    """Two bytes an entry: what it is, and where it leads. Every input has to be accounted for."""
    manifest = Manifest.from_dict({
        "name": "fuzz", "source": {"kind": "folder", "shares": {"train": 1.0}}, "resolutions": [64],
        "inputs": [{"name": "v", "views": 1, "encodings": ["tsdf"]}], "limits": {"max_bytes": 4096}})
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        root = Path(folder)
        for what, which in zip(data[0:32:2], data[1:32:2], strict=False):
            path = root / NAMES[what % 8]
            if path.is_symlink() or path.exists():
                continue
            match what // 8 % 4:
                case 0:
                    path.symlink_to(LINKS[which % len(LINKS)])
                case 1:
                    path.mkdir()
                case 2:
                    os.mkfifo(path)
                case _:
                    path.write_bytes(data[which:])
        plan = make_plan(manifest, root)
        inputs = [path for path in root.iterdir() if path.suffix in FORMATS and not path.is_dir()]
        if len(plan.items) + len(plan.exclusions) != len(inputs):
            raise AssertionError(f"{len(inputs)} inputs, {plan}")
        json.dumps([row.to_json() for row in plan.exclusions], ensure_ascii=False).encode()
        for item in plan.items:
            try:
                read_item(manifest, item, folder)
            except OcnfError as error:
                str(error).encode()
                if b"root:" in str(error).encode():
                    raise AssertionError("quotes another file") from error


# ---- checkpoints and the state of training


class Checkpoints:
    """A tiny network's checkpoint and state, whose header or whose bytes the fuzzer makes."""

    def __init__(self) -> None:
        import torch

        from ocnf_model.header import Architecture, Header, TrainingData
        from ocnf_model.network import Carry, Join, Output
        from ocnf_model.training.train_state import TrainState, save_state

        logging.disable()  # the note on files without a checksum
        self._folder = Path(tempfile.mkdtemp(dir="/dev/shm"))
        atexit.register(shutil.rmtree, self._folder, ignore_errors=True)
        kind = Architecture(encoding=Encoding.TSDF, join=Join.CONCAT, carry=Carry.FEATURES,
                            output=Output.TSDF, channels=(1, 1, 1), band=1.0)
        self._level = kind.network(1).levels[0]
        self._optimiser = torch.optim.Adam(self._level.parameters())
        torch.cat([p.reshape(-1) for p in self._level.parameters()]).sum().backward()
        self._optimiser.step()
        data = TrainingData(name="d", checksum="0" * 64, variant="v", n_train=3, n_val=2, extent=3.0,
                         truncation_voxels=2.0)
        header = Header(level=1, resolution=32, architecture=kind, data=data, epoch=1, steps=1, metrics={},
                        settings={}, built_on=None, torch="2")
        self.header = canonical_json(header.to_dict())
        state = TrainState(step=1, steps=1, loader={"epoch": 0, "step": 1}, loss_sum=1.0, loss_count=1.0)
        save_state(self._folder, state, self._level, self._optimiser)
        self.state_file = (self._folder / "state.safetensors").read_bytes()
        self.state = self._header_of(self.state_file)
        self.write_header("level-1.safetensors", self.header, self._level.state_dict())
        self.file = (self._folder / "level-1.safetensors").read_bytes()

    def _header_of(self, blob: bytes) -> bytes:
        size = int.from_bytes(blob[:8], "little")
        header = json.loads(json.loads(blob[8:8 + size])["__metadata__"]["ocnf"])
        del header["sha256"]
        return canonical_json(header)

    def write_header(self, name: str, text: bytes, tensors: Any) -> None:
        """The file with this text for its header, and where it is JSON with a checksum that fits."""
        import safetensors.torch

        from ocnf_model.tensorfile import write_tensors

        try:
            header = json.loads(text)
            write_tensors(self._folder / name, tensors, {**header})
        except (ValueError, TypeError, RecursionError):
            blob = safetensors.torch.save(dict(tensors), {"ocnf": text.decode(errors="replace")})
            (self._folder / name).write_bytes(blob)

    def read_state(self) -> None:
        """Read the state as a run that is resumed does."""
        from ocnf_model.training.train_state import check_progress, check_step, load_state, restore

        state, tensors = load_state(self._folder)
        check_progress(self._folder, state, [2], [32])
        check_step(self._folder, state, 2, 1, exact=True)
        restore(tensors, self._level, self._optimiser)

    def state_bytes(self, data: bytes) -> None:
        """A state file of these bytes."""
        (self._folder / "state.safetensors").write_bytes(data)
        self.read_state()

    def state_header(self, data: bytes) -> None:
        """A state with this header."""
        from ocnf_model.tensorfile import read_tensors

        path = self._folder / "state.safetensors"
        path.write_bytes(self.state_file)
        self.write_header(path.name, data, read_tensors(path)[0])
        self.read_state()

    def checkpoint_bytes(self, data: bytes) -> None:
        """A checkpoint of these bytes."""
        from ocnf_model.checkpoint import open_run

        (self._folder / "level-1.safetensors").write_bytes(data)
        open_run(self._folder)

    def checkpoint_header(self, data: bytes) -> None:
        """A checkpoint with this header."""
        from ocnf_model.checkpoint import open_run

        self.write_header("level-1.safetensors", data, self._level.state_dict())
        open_run(self._folder)


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
    checkpoints = Checkpoints()
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
        "mesh .glb": (mesh(".glb"), [glb(text) for text in gltf_headers()]),
        "GLB header": (lambda text: mesh(".glb")(glb(text)), gltf_headers()),
        "folder of meshes": (plan_folder, [bytes(range(0, 64, 2)), bytes(range(0, 255, 8))]),
        "state file": (checkpoints.state_bytes, [checkpoints.state_file]),
        "state header": (checkpoints.state_header, [checkpoints.state]),
        "checkpoint file": (checkpoints.checkpoint_bytes, [checkpoints.file]),
        "checkpoint header": (checkpoints.checkpoint_header, [checkpoints.header]),
    }


def fuzz(name: str, seconds: float, findings: Path) -> None:
    """Fuzz one target in this process, which ends with it: the numbers go to standard output."""
    import atheris

    read, seeds = targets()[name]
    tried = accepted = 0
    end = float("inf")  # until the first input: libraries take their time to load

    def once(data: bytes) -> None:
        nonlocal tried, accepted, end
        end = min(end, time.monotonic() + seconds)
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
    for module in [module for key, module in sys.modules.items() if key.startswith("ocnf_")]:
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
