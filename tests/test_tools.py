"""The tools see what is right, and what is wrong, in a small data set."""

import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.generation import generate
from ocnf_data.inspection import check as physics
from ocnf_data.inspection import stats
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree
from ocnf_data.shards import browse
from ocnf_data.shards.browse import StoredSample, find_sample, stored_samples
from ocnf_model.evaluation.run import Evaluation
from ocnf_model.evaluation.summary import ALL, Summary

TOOLS = Path(__file__).parent.parent / "tools"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    out = tmp_path_factory.mktemp("tools") / "data"
    manifest = Manifest.from_dict({
        "name": "small", "source": {"kind": "shapes", "categories": ["chair", "mug"], "counts": {"train": 2}},
        "camera": {"rig": "fibonacci16", "width": 160, "height": 120, "fx": 88, "fy": 88, "cx": 79, "cy": 61},
        "resolutions": [32, 64],
        "inputs": [{"name": "v3", "views": 3, "sigma": 0.02,
                    "encodings": ["occupancy", "tsdf", "tdf_occupancy", "histogram"]}]})
    assert generate(manifest, out, progress=False).samples == 2
    return out


def run(tool, *args, status=0):
    done = subprocess.run([sys.executable, TOOLS / tool, *map(str, args)], capture_output=True, text=True,
                          env={**os.environ, "COLUMNS": "200", "PYTHONPATH": str(TOOLS.parent)}, check=False)
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_samples_are_found_and_decoded(data):
    keys = [sample.key for sample in stored_samples(str(data))]
    assert len(keys) == len(set(keys)) == 2
    sample = find_sample(str(data), keys[1])
    assert sample.facts["key"] == keys[1] and sample.split == "train"
    assert sample.octree("target-64.oct").n_leaves == sample.facts["leaf_counts"]["target-64.oct"]


def test_a_missing_sample_is_named(data):
    with pytest.raises(OcnfError, match="no such sample") as error:
        find_sample(str(data), "sofa-1")
    assert error.value.field == "sofa-1"


def test_what_generation_wrote_is_physically_right(data):
    text = run("check_shards.py", data, "--samples", 2, "--cells", 4000)
    # 2 samples x 2 resolutions x (3 of the target + 2 of each of 4 encodings)
    assert "44 of 44 checks of 2 samples passed" in text


@pytest.mark.parametrize(("member", "spoil", "check"), [
    ("target-64.oct", lambda v: np.clip(v + 0.01, -1, 1), "cells"),
    ("target-64.oct", lambda v: np.roll(v, 2, axis=3), "surface"),
    ("v3-tsdf-32.oct", lambda v: np.where(np.abs(v) < 1, -v, v), "cells"),
    ("v3-histogram-64.oct", lambda v: v[::-1].copy(), "cells"),
    ("v3-occupancy-64.oct", lambda v: 1 - v, "cells"),
    ("v3-tdf_occupancy-64.oct", lambda v: np.stack([v[0], 1 - v[1]]), "cells"),
])
def test_an_octree_that_is_wrong_is_noticed(data, member, spoil, check, monkeypatch):
    """The spoilt octree is stored as well as a right one: only physics can tell."""
    right = StoredSample.octree

    def octree(sample, name):
        found = right(sample, name)
        return GridOctree.from_dense(spoil(found.to_dense()).astype(np.float32)) if name == member else found

    monkeypatch.setattr(StoredSample, "octree", octree)
    sample = next(stored_samples(str(data)))
    manifest = Manifest.from_dict(browse.load_dataset(str(data)).manifest)
    checks = physics.check_sample(sample, manifest, None, 4000, 0)
    wrong = {(c.member, c.check) for c in checks if not c.ok}
    assert (member, check) in wrong
    assert {name for name, _ in wrong} == {member}


def test_values_out_of_range_are_noticed():
    from ocnf_data.encodings import Encoding

    def octree(*values):
        return GridOctree(np.zeros((1, 1, 1, 2), np.uint64), np.float32([values]))

    assert physics.check_range(octree(-1), Encoding.TSDF)[1]
    assert not physics.check_range(octree(-1.01), Encoding.TSDF)[1]
    assert not physics.check_range(octree(-0.5), Encoding.OCCUPANCY)[1]
    assert physics.check_range(octree(*[0.1] * 10), Encoding.HISTOGRAM)[1]
    assert not physics.check_range(octree(*[0.11] * 10), Encoding.HISTOGRAM)[1]


def test_a_mesh_that_has_changed_is_refused(data):
    sample = next(stored_samples(str(data)))
    manifest = Manifest.from_dict(browse.load_dataset(str(data)).manifest)
    from ocnf_data.generation.remake import remake

    facts = {**sample.facts, "mesh": {**sample.facts["mesh"], "sha256": "0" * 64}}
    with pytest.raises(OcnfError) as error:
        remake(manifest, facts)
    assert error.value.code == "changed"


def test_pictures_and_statistics_are_drawn(data, tmp_path):
    import cv2

    text = run("show_sample.py", data, "--pictures", tmp_path, "--encoding", "tsdf", "--random", 1)
    picture = cv2.imread(text.split()[-1])
    assert picture.shape[1] > 1000 and len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000
    text = run("shard_stats.py", data, "--plot", tmp_path / "stats.png", "--band-samples", 0)
    assert "chair" in text and "mug" in text and "v3 histogram" in text
    assert cv2.imread(str(tmp_path / "stats.png")).shape[1] > 600


def test_statistics_are_those_of_the_dense_volumes(data):
    columns = stats.collect(str(data), "train", band_samples=0, mad=True)
    samples = list(stored_samples(str(data)))
    truth = [sample.octree("target-64.oct").to_dense() for sample in samples]
    noisy = [sample.octree("v3-tsdf-64.oct").to_dense() for sample in samples]
    tau = 3 / 64 * 32 / 15
    np.testing.assert_allclose(columns["MAD mm, v3 64³"]["all"],
                               [1000 * tau * np.abs(a - b).mean() for a, b in zip(truth, noisy, strict=True)],
                               rtol=1e-5)
    np.testing.assert_allclose(columns["band 64³"]["all"], [100 * (np.abs(t) < 1).mean() for t in truth])
    np.testing.assert_allclose(columns["coverage"]["all"], [100 * s.facts["coverage"] for s in samples])


def test_a_tool_says_in_a_sentence_what_is_missing(tmp_path, data):
    for tool in ("check_shards.py", "show_sample.py", "shard_stats.py"):
        text = run(tool, tmp_path / "nothing", status=1)
        assert "error:" in text and "nothing" in text and "Traceback" not in text
    assert "v4" in run("show_sample.py", data, "--variant", "v4", "--pictures", tmp_path, status=1)


@pytest.mark.parametrize(("ours", "won"), [((5.0, 2.0), True), ((5.0, 4.0), False), ((12.0, 2.0), False)])
def test_the_training_demo_wants_to_win_at_both_resolutions(monkeypatch, ours, won):
    monkeypatch.syspath_prepend(str(TOOLS))
    from demo_train import PAPER, SETTINGS, differences, verdict

    mads = {(64, "VolFus"): 20.0, (64, "TV-L1"): 10.0, (64, "Ours"): ours[0],
            (128, "VolFus"): 3.0, (128, "TV-L1"): 5.0, (128, "Ours"): ours[1]}
    summaries = [Summary("v2", ALL, resolution, method, 24, mad, 1, 1, 1, 1)
                 for (resolution, method), mad in mads.items()]
    console = Console(file=io.StringIO(), record=True)
    assert verdict(Evaluation([], summaries, [], {}, ""), console) is won
    assert (console.export_text().count("not better") == 0) is won
    said = " ".join(differences())
    assert str(SETTINGS.channels) in said and f"{SETTINGS.stage(0).learning_rate:g}" in said
    assert f"{PAPER.stage(0).learning_rate:g}" in said
