"""The checkpoints that come with the package: whole, described, and better than both baselines."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ocnf_data import generate
from ocnf_data.manifest import Manifest, load_manifest
from ocnf_model.checkpoint import open_run
from ocnf_model.cli import app
from ocnf_model.evaluation.methods import DEFAULT_WEIGHTS, Method
from ocnf_model.evaluation.run import run_evaluate
from ocnf_model.evaluation.summary import ALL
from ocnf_model.evaluation.weights import read_weights

FOLDER = Path(str(files("ocnf_model"))) / "pretrained"


def test_all_levels_are_there_and_go_together() -> None:
    run = open_run("pretrained")
    assert run.resolutions == [64, 128, 256] and run.network.encoding == "histogram"
    assert {header.data.checksum for header in run.headers} == {run.data.checksum}
    assert run.data.n_train >= 200 and run.data.variant == "v4_n02"
    assert sum(path.stat().st_size for path in FOLDER.glob("*.safetensors")) < 20e6


def test_the_card_gives_the_validation_errors_of_the_files() -> None:
    card = (FOLDER / "README.md").read_text()
    for header in open_run("pretrained").headers:
        mad_mm = header.metrics["mad_mm"]
        assert f"| {header.resolution}³ | {header.epoch} | {header.steps:,} | {mad_mm:.3f} |" in card


def test_info_shows_it() -> None:
    result = CliRunner().invoke(app, ["info", "pretrained"], env={"COLUMNS": "120"})
    assert result.exit_code == 0 and "5,157,822" in result.output


def test_the_weights_of_tvl1_were_chosen_for_its_data() -> None:
    chosen, _ = read_weights(FOLDER / "tvl1.json")
    assert set(chosen) == {("v4_n02", resolution) for resolution in (64, 128, 256)}
    assert {resolution: weight for (_, resolution), weight in chosen.items()} == DEFAULT_WEIGHTS


@pytest.mark.slow
def test_better_than_both_baselines_on_shapes_it_never_saw(tmp_path: Path) -> None:
    data = tmp_path / "set"
    generate(Manifest.from_dict({
        "schema": 1, "name": "unseen", "seed": 77, "resolutions": [64, 128],
        "source": {"kind": "shapes", "categories": ["chair", "guitar"], "counts": {"test": 2}},
        "inputs": [{"name": "v4_n02", "views": 4, "sigma": 0.02, "encodings": ["histogram", "tsdf"]}],
    }), data, jobs=1, progress=False)
    found = run_evaluate("pretrained", str(data), n_figures=0)
    mads = {(one.resolution, one.method): one.mad_mm for one in found.summaries if one.category == ALL}
    assert not any("default" in note for note in found.notes)  # TV-L1 took the file's weights
    for resolution in (64, 128):
        assert mads[resolution, "Ours"] < 0.8 * mads[resolution, "VolFus"]
        assert mads[resolution, "Ours"] < mads[resolution, "TV-L1"]


def test_the_network_for_scans_is_a_blend_and_its_card_has_its_figures() -> None:
    scan = open_run("pretrained-scan")
    assert scan.resolutions == open_run("pretrained").resolutions and scan.network.blend
    manifest = load_manifest(FOLDER / "scan" / "manifest.yaml")
    card = (FOLDER / "scan" / "README.md").read_text()
    for header in scan.headers:
        assert header.data.name == manifest.name
        found = header.metrics
        assert f"| {header.resolution}³ | {header.epoch} | {header.steps:,} | {found['mad_mm']:.3f} | " \
               f"{found['iou']:.3f} | {found['f_score']:.3f} |" in card
    assert sum(path.stat().st_size for path in (FOLDER / "scan").glob("*.safetensors")) < 9e6


@pytest.mark.slow
def test_on_clean_depth_the_network_for_scans_lies_nearer_to_the_surface(tmp_path: Path) -> None:
    data = tmp_path / "set"
    generate(Manifest.from_dict({
        "schema": 1, "name": "clean", "seed": 5, "resolutions": [64, 128, 256],
        "source": {"kind": "shapes", "categories": ["table"], "counts": {"test": 1}},
        "inputs": [{"name": "v12_n00", "views": 12, "sigma": 0.0, "encodings": ["histogram", "tsdf"]}],
    }), data, jobs=1, progress=False)
    scores = {}
    for name in ("pretrained", "pretrained-scan"):
        found = run_evaluate(name, str(data), methods=(Method.OURS,), n_figures=0)
        scores[name] = next(one for one in found.summaries if one.category == ALL and one.resolution == 256)
    assert scores["pretrained-scan"].mad_mm < 0.9 * scores["pretrained"].mad_mm
