"""Kernels in threads, in forked processes, and serial: the same results."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from ocnf_data import GridOctree
from ocnf_data.octree import threads
from ocnf_data.octree.triangles import cell_triangles

DENSE = np.random.default_rng(0).integers(-2, 2, (2, 16, 24, 32)).astype(np.float32) / 2

IN_WORKERS = """
import numpy as np
from torch.utils.data import DataLoader, Dataset
from ocnf_data import GridOctree
from ocnf_data.octree.triangles import cell_triangles

class Volumes(Dataset):
    def __len__(self):
        return 4
    def __getitem__(self, i):
        volume = np.random.default_rng(i).integers(-1, 2, (1, 16, 16, 16)).astype(np.float32)
        octree = GridOctree.from_dense(volume)
        return octree.to_dense(), len(cell_triangles(octree, 1.0).triangles)

whole = [Volumes()[i] for i in range(4)]  # the main process has run every kernel
for (ours, n), (theirs, m) in zip(DataLoader(Volumes(), batch_size=None, num_workers=2,
                                             multiprocessing_context="fork"), whole):
    assert (ours.numpy() == theirs).all() and n == m > 0
print("same")
"""


def test_workers_that_are_forked_run_them() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_THREADING_LAYER"}
    done = subprocess.run([sys.executable, "-c", IN_WORKERS], capture_output=True, text=True, timeout=300,
                          env={**environment, "NUMBA_NUM_THREADS": "2"}, check=False)
    assert (done.returncode, done.stdout) == (0, "same\n"), done.stderr


def test_the_serial_kernels_give_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    def results() -> list[np.ndarray]:
        octree = GridOctree.from_dense(DENSE)
        first = octree.with_data(octree.data[:, :1].copy())
        places = np.argwhere(np.ones(DENSE.shape[1:], bool))
        return [octree.trees, octree.data, octree.to_dense(), octree.gather(places),
                cell_triangles(first, 1.0).triangles]

    parallel = results()
    monkeypatch.setattr(threads, "_forked", True)
    for ours, theirs in zip(results(), parallel, strict=True):
        np.testing.assert_array_equal(ours, theirs)
