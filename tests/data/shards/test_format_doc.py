"""The code that docs/format.md prints runs, without this package, and reads what was written."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

from ocnf_data.files.storage import Store
from ocnf_data.octree.codec import decode, decode_raw
from ocnf_data.octree.stored import STORAGE
from ocnf_data.verify.repair import restore_catalogues

DOC = Path(__file__).parents[3] / "docs" / "format.md"
Members = dict[str, bytes]


def code_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", DOC.read_text(), flags=re.DOTALL)


@pytest.mark.parametrize("number", [0, 1])
def test_the_printed_code_runs(number: int, octree_set: Store,
                               octree_samples: list[tuple[str, Members]]) -> None:
    code = code_blocks()[number].replace("target-64.oct", "target-16.oct")
    lines = subprocess.check_output([sys.executable, "-c", code], cwd=octree_set.root).decode().splitlines()
    if number == 0:
        assert len([line for line in code.splitlines() if line.strip()]) <= 10
        assert "ocnf" not in code
        octrees = [(f"{key}.{name}", decode(payload)) for key, members in octree_samples[:2]
                   for name, payload in members.items() if name != "json"]
        assert [(line.split()[0], int(line.split()[-1])) for line in lines] == [
            (name, octree.n_leaves) for name, octree in octrees]
    else:
        assert [line.split() for line in lines] == [
            [key, "chair", str(decode(members["target-16.oct"]).n_leaves)]
            for key, members in octree_samples[:2]]


def test_the_printed_code_reads_a_catalogue(octree_set: Store,
                                            octree_samples: list[tuple[str, Members]]) -> None:
    restore_catalogues(octree_set)
    code = code_blocks()[2]
    assert "ocnf_data" not in code
    printed = subprocess.check_output([sys.executable, "-c", code], cwd=octree_set.root).decode()
    assert ast.literal_eval(printed) == {key: "chair" for key, _ in octree_samples[:3]}


def test_the_arrays_of_the_ten_lines_are_the_octree(octree_set: Store) -> None:
    """The documented bits and rows against the package's own decoder."""
    zstandard = pytest.importorskip("zstandard")
    from safetensors.numpy import load

    with tarfile.open(octree_set.root / "train/shard-000000.tar") as tar:
        for entry in tar:
            if entry.name.endswith(".json"):
                continue
            payload = tar.extractfile(entry).read()
            arrays, raw = load(zstandard.decompress(payload)), decode_raw(payload)
            np.testing.assert_array_equal(arrays["data"], raw.data)
            words = np.zeros((*raw.trees.shape[:3], 16), np.uint8)
            words[..., :10] = arrays["trees"]
            np.testing.assert_array_equal(words.view("<u8"), raw.trees)
            content = zstandard.decompress(payload)
            header = json.loads(content[8:8 + int.from_bytes(content[:8], "little")])
            meta = json.loads(header["__metadata__"]["ocnf"])
            assert meta["kind"] == raw.kind
            assert meta["divisor"] == STORAGE[raw.kind].divisor
            assert meta["shape"] == list(raw.shape)


def test_the_table_of_kinds_is_that_of_the_code() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*)$", DOC.read_text(), flags=re.MULTILINE))
    assert set(rows) == set(STORAGE)
    for kind, storage in STORAGE.items():
        stored, divisor, error = (cell.strip() for cell in re.split(r"(?<!\\)\|", rows[kind])[:3])
        assert stored.startswith(str(storage.dtype))
        assert f"{storage.channels} channel" in stored
        assert int(divisor) == storage.divisor
        assert error.startswith("1/")


def test_webdataset_reads_the_same_bytes(octree_set: Store,
                                         octree_samples: list[tuple[str, Members]]) -> None:
    webdataset = pytest.importorskip("webdataset")
    urls = [str(octree_set.root / f"train/shard-00000{n}.tar") for n in (0, 1)]
    read = {sample["__key__"]: {name: data for name, data in sample.items() if not name.startswith("__")}
            for sample in webdataset.WebDataset(urls, shardshuffle=False)}
    assert read == dict(octree_samples[:3])
    for sample, (_, members) in zip(read.values(), octree_samples[:3], strict=True):
        assert list(sample) == list(members)
