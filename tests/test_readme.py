"""The README's Python runs as printed."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from ocnf_data.generation import generate
from ocnf_data.manifest import Manifest

README = Path(__file__).parent.parent / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a data set named as in the README."""
    folder = tmp_path_factory.mktemp("readme")
    generate(Manifest.from_dict({
        "name": "small", "source": {"kind": "shapes", "categories": ["chair", "mug"], "counts": {"train": 3}},
        "camera": {"rig": "fibonacci8", "width": 64, "height": 48, "fx": 35, "fy": 35, "cx": 32, "cy": 24},
        "resolutions": [64, 128],
        "inputs": [{"name": "v2", "views": 2, "sigma": 0.02, "encodings": ["histogram"]}],
    }), folder / "OUT", progress=False)
    return folder


def run(code, folder):
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_the_loader_goes_on_where_its_state_says(folder):
    loading = next(block for block in BLOCKS if "ShardDataset" in block)
    shapes = "print(*octrees.trees.shape, octrees.to_float().shape[1], len(truth.grids()), state['step'])"
    assert run(loading + shapes, folder) == ["4", "8", "8", "8", "2", "10", "4", "0"]


def test_webdataset_reads_the_shards(folder):
    reading = next(block for block in BLOCKS if "webdataset" in block)
    look = "for sample in samples: print(sample['v2-histogram-64.oct']['data'].shape[1])"
    assert run(reading + look, folder) == ["10"] * 3
