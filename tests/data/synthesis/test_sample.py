"""Poses and draws against what they are defined as, and the worker that comes by a used thread pool."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from ocnf_data.shapes import make_shape
from ocnf_data.synthesis.draw import Body, draw_body, draw_look
from ocnf_data.synthesis.sample import pose
from ocnf_data.synthesis.sources import open_sources

SHAPES = ["shapes:chair:train:202889675084859",
          "shapes:chair:train:62759204644261",
          "shapes:table:train:100298522074835"]
SCALES = [0.767815, 0.55831, 0.755057]
TURNS = [0.323175, 0.0, 0.045469]
VIEWS = [(0, 1), (0,), (5, 8, 9, 10), (2, 6)]
SIGMAS = [0.028382, 0.028126, 0.009496, 0.027489]


@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_a_pose_is_the_mesh_turned_centred_and_scaled(small, scale):
    manifest = small({"rotate": "any"})
    for number in range(4):
        body = draw_body(open_sources(manifest, None, "train"), 0, 0, number)
        assert body.rotation is not None and body.item.index is not None
        mesh = make_shape(body.item.category, manifest.seed, body.item.index, "train")
        turned = np.array([body.rotation @ vertex for vertex in mesh.vertices])
        low, high = turned.min(axis=0), turned.max(axis=0)
        expected = (turned - (low + high) / 2) * 0.95 * 3 / (high - low).max() * scale
        found = pose(manifest, Body(body.item, body.rotation, scale), None).vertices
        np.testing.assert_allclose(found, expected, atol=1e-12)
        assert np.ptp(found, axis=0).max() == pytest.approx(2.85 * scale)


def test_draws_stay_what_they_are_for_the_runs_that_were_begun(small):
    """Other draws would be other samples under a state that is resumed: `_VERSION` would have to change."""
    manifest = small({"rotate": {"none": 1, "upright": 1, "any": 2}, "scale": [0.5, 1.0],
                      "directions": {"rig": 1, "random": 1, "sphere": 1}, "views": [1, 6]})
    sources = open_sources(manifest, None, "train")
    bodies = [draw_body(sources, 7, 1, number, attempt) for number, attempt in ((0, 0), (1, 0), (1, 1))]
    assert [body.item.source for body in bodies] == SHAPES
    assert [round(body.scale, 6) for body in bodies] == SCALES
    turns = [np.eye(3) if body.rotation is None else body.rotation for body in bodies]
    assert [round(float(turn[0, 1]), 6) for turn in turns] == TURNS
    looks = [draw_look(sources, 7, 3, number) for number in range(4)]
    assert [look.views for look in looks] == VIEWS
    assert [round(look.sigma, 6) for look in looks] == SIGMAS


def test_a_worker_may_be_forked_behind_a_used_thread_pool():
    """OpenMP's pool does not survive a fork; a worker that touched it would be killed."""
    code = """
import numba, yaml
from torch.utils.data import DataLoader
from ocnf_data import SynthesisDataset
from ocnf_data.manifest import Manifest
numba.set_num_threads(2)
manifest = Manifest.from_dict(yaml.safe_load('''
name: small
source: {kind: shapes, categories: [chair], counts: {train: 1}}
camera: {rig: fibonacci12, width: 64, height: 48, fx: 35, fy: 34, cx: 31, cy: 25}
resolutions: [16]
inputs: [{name: v2, views: 2, encodings: [tsdf]}]
synthesis: {samples_per_epoch: 2, views: [2, 2]}
'''))
dataset = SynthesisDataset(manifest, [16], "tsdf", rank=0, world_size=1)
alone = [batch.arena.numpy().tobytes() for batch in dataset]
dataset.set_epoch(0)
loader = DataLoader(dataset, batch_size=None, num_workers=1, timeout=60)
assert [batch.arena.numpy().tobytes() for batch in loader] == alone
"""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2", "NUMBA_THREADING_LAYER": "omp"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True,
                            timeout=120, check=False)
    assert result.returncode == 0, result.stderr
