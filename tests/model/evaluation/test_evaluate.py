"""Evaluation equals the dense computation, and says what it lacks."""

from __future__ import annotations

import csv
import io
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from ocnf_data import generate
from ocnf_data.errors import OcnfError
from ocnf_data.manifest import Manifest
from ocnf_data.octree import GridOctree
from ocnf_model import OctNetFusion, OctreeBatch, load_network
from ocnf_model.baselines import tvl1
from ocnf_model.cli import app
from ocnf_model.evaluation.figure import caption, draw_surfaces
from ocnf_model.evaluation.measure import TRUTH, Row
from ocnf_model.evaluation.methods import default_weight
from ocnf_model.evaluation.run import Evaluation, evaluate, run_choose_weight, run_evaluate
from ocnf_model.evaluation.summary import Summary, summarise
from ocnf_model.evaluation.tables import markdown
from ocnf_model.measures.figures import SurfaceFigures
from ocnf_model.measures.regions import Regions

RESOLUTIONS = (32, 64)


@pytest.fixture(scope="module")
def evaluation(tiny: str, network: OctNetFusion) -> Evaluation:
    """All methods on all variants."""
    return evaluate(network, tiny, n_figures=1)


def dense_figures(predicted: np.ndarray, true: np.ndarray, tau: float) -> tuple[float, ...]:
    """MAD in mm, IoU, precision, recall of two dense volumes."""
    p, t = predicted < 0, true < 0
    both = (p & t).sum()
    clipped = [np.clip(volume.astype(np.float64), -1, 1) for volume in (predicted, true)]
    precision = both / p.sum() if p.any() else 0.0
    return abs(clipped[0] - clipped[1]).mean() * tau * 1000, both / (p | t).sum(), precision, both / t.sum()


def test_every_figure_equals_the_dense_one(evaluation: Evaluation, network: OctNetFusion,
                                           members: Callable[[str, str], GridOctree]) -> None:
    @cache
    def histograms_of(key: str, variant: str) -> list[GridOctree]:
        return [members(key, f"{variant}-histogram-{resolution}") for resolution in RESOLUTIONS]

    @cache
    def outputs_of(key: str, variant: str) -> list[OctreeBatch]:
        return network([OctreeBatch.from_grids([one]) for one in histograms_of(key, variant)])

    met = set()
    for row in evaluation.rows:
        histograms = histograms_of(row.key, row.variant)
        level = RESOLUTIONS.index(row.resolution)
        if row.method == "VolFus":
            predicted = members(row.key, f"{row.variant}-tsdf-{row.resolution}").to_dense()[0]
        elif row.method == "VolFus*":
            centres = np.minimum(np.linspace(-1.125, 1.125, 10), 1)
            predicted = np.tensordot(centres, histograms[level].to_dense(), 1)
        elif row.method == "TV-L1":
            predicted = tvl1(histograms[level], default_weight(row.resolution)).to_dense()[0]
        else:
            predicted = outputs_of(row.key, row.variant)[level].to_dense()[0, 0].numpy()
        truth = members(row.key, f"target-{row.resolution}").to_dense()[0]
        tau = 3 * 32 / 15 / row.resolution
        found = row.mad_mm, row.iou, row.precision, row.recall
        known = np.abs(np.clip(predicted, -1, 1) - truth)[truth > -1].mean() * 1000 * tau
        assert row.known_mm == pytest.approx(known, rel=1e-3)
        near = 1e-3 if row.method == "VolFus*" else 1e-6  # rounding decides where the mean is about 0
        np.testing.assert_allclose(found, dense_figures(predicted, truth, tau), rtol=near, atol=near)
        met.add((row.key, row.variant, row.resolution, row.method))
    # 2 models, 2 resolutions, 2 variants, 3 methods; VolFus is exact where TSDFs are stored.
    assert len(met) == len(evaluation.rows) == 24
    assert {(variant, method) for _, variant, _, method in met if "Vol" in method} == {
        ("v4", "VolFus"), ("v2", "VolFus*")}


def test_volfus_of_a_histogram_is_near_the_exact_one(
        tiny: str, evaluation: Evaluation, members: Callable[[str, str], GridOctree]) -> None:
    centres = np.minimum(np.linspace(-1.125, 1.125, 10), 1)
    for key in {row.key for row in evaluation.rows}:
        exact = members(key, "v4-tsdf-64").to_dense()[0]
        approximate = np.tensordot(centres, members(key, "v4-histogram-64").to_dense(), 1)
        difference = np.abs(exact - np.clip(approximate, -1, 1))
        assert difference.max() < 0.0625 + 0.03  # and what storage rounds
        assert difference.mean() < 0.002
    assert any("VolFus*" in note and "v2" in note for note in evaluation.notes)


def test_runtime_is_of_what_was_run(evaluation: Evaluation) -> None:
    for row in evaluation.rows:
        assert math.isnan(row.seconds) == row.method.startswith("VolFus")
    ours = [row for row in evaluation.rows if row.method == "Ours"]
    assert all(fine.seconds > coarse.seconds for coarse, fine in zip(ours[::2], ours[1::2], strict=True))


def test_means_are_over_models_not_over_categories() -> None:
    rows = [Row("a", "chair", "v", 64, "Ours", mad, 0.5, 1, 1, seconds, 9)
            for mad, seconds in ((1.0, 1.0), (2.0, 50.0), (6.0, 2.0))]
    rows.append(Row("d", "lamp", "v", 64, "Ours", 11.0, 0.5, 1, 1, 3.0, 9))
    means = {one.category: one for one in summarise(rows)}
    assert list(means) == ["all", "chair", "lamp"]
    assert (means["all"].mad_mm, means["all"].n_models, means["chair"].mad_mm) == (5.0, 4, 3.0)
    assert means["chair"].seconds == 2.0  # the median


def test_a_category_named_all_is_one_of_its_own() -> None:
    rows = [Row("a", category, "v", 64, "Ours", 1.0, 0.5, 1, 1, 1.0, 9) for category in ("all", "lamp")]
    found = {one.category: one.n_models for one in summarise(rows)}
    assert found == {"all": 2, "all (category)": 1, "lamp": 1}


def test_what_is_written(evaluation: Evaluation, tmp_path: Path) -> None:
    evaluation.write(tmp_path)
    with (tmp_path / "models.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(evaluation.rows)
    for line, row in zip(lines, evaluation.rows, strict=True):
        assert (line["key"], float(line["mad_mm"])) == (row.key, row.mad_mm)
        assert (line["seconds"] == "") == math.isnan(row.seconds)
    text = (tmp_path / "evaluation.md").read_text()
    for one in evaluation.summaries:
        assert f"{one.mad_mm:.3f}" in text
    assert "VolFus\\*" in text and all(note in text for note in evaluation.notes)
    pictures = list(tmp_path.glob("*.png"))
    assert sorted(path.name[:2] for path in pictures) == ["v2", "v4"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in pictures)


def test_a_figure_has_a_row_a_resolution_and_a_column_a_method() -> None:
    import cv2

    def tetrahedron(scale: float) -> tuple[np.ndarray, np.ndarray]:
        corners = scale * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        return corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])

    surfaces = {(64, TRUTH): tetrahedron(1), (64, "A"): tetrahedron(0.3), (128, TRUTH): tetrahedron(1),
                (128, "A"): (np.empty((0, 3)), np.empty((0, 3), int))}
    picture = cv2.imdecode(np.frombuffer(draw_surfaces(surfaces, "title"), np.uint8), cv2.IMREAD_GRAYSCALE)
    ink = [[(part < 250).mean() for part in np.array_split(half[:, 40:], 2, axis=1)]
           for half in np.array_split(picture[60:], 2)]
    assert 0.01 < ink[0][0] < ink[0][1] / 3 and ink[1][0] < 0.001 < ink[1][1]


def test_methods_that_the_data_cannot_feed(tiny: str, network: OctNetFusion) -> None:
    tsdf = OctNetFusion("tsdf", levels=2, channels=(2, 2, 2)).eval()
    found = evaluate(tsdf, tiny, methods=["ours"], limit=1)
    assert {row.variant for row in found.rows} == {"v4"}
    assert any("Ours needs tsdf, which variant v2 lacks" in note for note in found.notes)
    occupancy = OctNetFusion("occupancy", levels=2, channels=(2, 2, 2)).eval()
    with pytest.raises(OcnfError, match=r"Ours needs occupancy, which variant v4 lacks"):
        evaluate(occupancy, tiny, methods=["ours", "tvl1"])
    with pytest.raises(OcnfError, match="no such method"):
        evaluate(network, tiny, methods=["magic"])
    with pytest.raises(OcnfError, match="no such split"):
        evaluate(network, tiny, split="train2")
    with pytest.raises(OcnfError, match="lacks the resolution of the network's first level"):
        evaluate(network, tiny, resolutions=(128, 256))


def test_a_network_that_reads_what_is_finer_guesses_it_where_the_data_ends(
        tiny: str, members: Callable[[str, str], GridOctree]) -> None:
    network = OctNetFusion(levels=2, channels=(2, 2, 2), finer=2).eval()
    found = evaluate(network, tiny, methods=["ours"], limit=1)
    rows = [row for row in found.rows if row.variant == "v2" and row.method != TRUTH]
    assert [row.resolution for row in rows] == list(RESOLUTIONS)
    said = "Ours at 64³ also reads the views at 128³, which it has to guess"
    assert any(said in note for note in found.notes)
    key = rows[0].key
    inputs = [OctreeBatch.from_grids([members(key, f"v2-histogram-{resolution}")])
              for resolution in RESOLUTIONS]
    for row, made in zip(rows, network(inputs), strict=True):
        truth = members(key, f"target-{row.resolution}").to_dense()
        mad = dense_figures(made.to_dense()[0].detach().numpy(), truth, 2.133333 * 3 / row.resolution)[0]
        assert row.mad_mm == pytest.approx(mad, rel=1e-4)
    coarse = OctNetFusion(levels=1, channels=(2, 2, 2), finer=1).eval()
    found = evaluate(coarse, tiny, methods=["ours"], limit=1)
    assert not any("guess" in note for note in found.notes)
    assert {row.resolution for row in found.rows if row.method != TRUTH} == {32}


def test_a_damaged_member_is_named(tiny: str, tmp_path: Path) -> None:
    shutil.copytree(tiny, tmp_path / "set")
    shard = min((tmp_path / "set" / "test").glob("*.tar"))
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 16
    shard.write_bytes(data)
    with pytest.raises(OcnfError, match=shard.name):
        evaluate(None, str(tmp_path / "set"))


def test_occupancy_is_compared_by_overlap(tmp_path: Path) -> None:
    source = {"kind": "shapes", "categories": ["chair"], "counts": {"test": 1}}
    entry = {"name": "v4", "views": 4, "sigma": 0.0, "encodings": ["tsdf", "occupancy"]}
    generate(Manifest.from_dict({"schema": 1, "name": "occ", "seed": 0, "source": source,
                                 "target": "occupancy", "resolutions": [32], "inputs": [entry]}),
             tmp_path / "set", jobs=1)
    network = OctNetFusion("occupancy", levels=1, channels=(2, 2, 2), output="occupancy").eval()
    found = evaluate(network, str(tmp_path / "set"), n_figures=1)
    assert {row.method for row in found.rows} == {"VolFus", "Ours"} and len(found.figures) == 1
    assert all(math.isnan(row.mad_mm) and 0 <= row.iou <= 1 for row in found.rows)
    assert next(row.recall for row in found.rows if row.method == "VolFus") > 0.7
    assert "IoU by category" in found.write(tmp_path / "out")[0].read_text()


def test_weights_are_chosen_written_and_used(tiny: str, tmp_path: Path) -> None:
    file = tmp_path / "tvl1.json"
    console = Console(record=True, file=io.StringIO())
    choices = run_choose_weight(tiny, out=file, resolutions=[32], console=console)
    assert [(one.variant, one.resolution, len(one.models)) for one in choices] == [("v4", 32, 1),
                                                                                  ("v2", 32, 1)]
    assert all(one.weight in one.weights and len(one.weights) >= 6 for one in choices)
    printed = console.export_text()
    assert "v4 at 32³, 1 models" in printed and f"{min(choices[0].mean_mm):.4f}" in printed
    text = json.loads(file.read_text())
    for one in text["choices"]:
        one["weight"] = 0.05  # far from any default
    file.write_text(json.dumps(text))
    usual, changed = (evaluate(None, tiny, methods=["tvl1"], weights=path, limit=1) for path in (None, file))
    for before, after in zip(usual.rows, changed.rows, strict=True):
        assert (before.mad_mm == after.mad_mm) == (before.resolution != 32)
    assert any("v4 at 32³" in note for note in usual.notes)
    assert not any("at 32³" in note for note in changed.notes)
    for broken in ("{", "[]", '{"schema": 2}', '{"schema": 1, "choices": [{"variant": "v", "resolution": 1, '
                                              '"weight": -1}]}'):
        file.write_text(broken)
        with pytest.raises(OcnfError, match="not a file of TV-L1 weights"):
            evaluate(None, tiny, methods=["tvl1"], weights=file)


def test_choosing_weights_is_silent_without_a_console(tiny: str, tmp_path: Path,
                                                      capsys: pytest.CaptureFixture[str]) -> None:
    run_choose_weight(tiny, out=tmp_path / "w.json", resolutions=[32])
    assert capsys.readouterr() == ("", "")


def test_the_command_chooses_weights_from_a_grid_of_ones_own(tiny: str, tmp_path: Path) -> None:
    def run(weights: str):
        return CliRunner().invoke(app, ["choose-weight", tiny, "--out", str(tmp_path / "w.json"),
                                        "--resolution", "32", "--weights", weights])

    assert run("1,2,4,8,16,32").exit_code == 0
    for choice in json.loads((tmp_path / "w.json").read_text())["choices"]:
        assert set(choice["weights"]) >= {1, 2, 4, 8, 16, 32}
        assert choice["mean_mm"][choice["weights"].index(choice["weight"])] == min(choice["mean_mm"])
    with pytest.raises(OcnfError, match="too few weights; found 2"):
        raise run("1,2").exception or AssertionError


def test_a_run_that_is_not_there(tiny: str, tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match="no such run"):
        run_evaluate(str(tmp_path / "none"), tiny)
    run_evaluate(str(tmp_path / "none"), tiny, methods=["volfus"], out=tmp_path / "out", limit=1, n_figures=0)
    assert (tmp_path / "out" / "evaluation.md").exists()


def test_a_network_in_training_or_of_completion_is_refused(tiny: str) -> None:
    with pytest.raises(OcnfError, match="network: the network is in training mode"):
        evaluate(OctNetFusion(levels=1, channels=(2, 2, 2)), tiny)
    with pytest.raises(OcnfError, match=r"network: not a module.*TrainedNetwork.*Take the `module`"):
        evaluate(load_network(device="cpu"), tiny)
    with pytest.raises(OcnfError, match="extra_channels: the network is one of completion"):
        evaluate(OctNetFusion(levels=1, channels=(2, 2, 2), extra_channels=2).eval(), tiny)


def test_the_table_by_category_has_one_measure(tmp_path: Path) -> None:
    """A network of occupancy has no MAD, plain fusion does: its IoU is not shown as millimetres."""
    figures = [Summary("v4", category, 64, method, 3, mad, iou, 0.5, 0.5, 1.0) for category in ("all", "mug")
               for method, mad, iou in (("VolFus", 11.542, 0.4), ("Ours", math.nan, 0.049))]
    for known, shown in ((figures, ["11.542", ""]), (figures[1::2], ["0.049"])):
        text = markdown(known, "title", [])
        table = text.split("by category\n\n")[1].split("\n\n")[0].splitlines()
        assert [cell.strip() for cell in table[-1].strip("|").split("|")][1:] == shown
        assert ("MAD in mm by category" in text) == (known is figures)


def test_a_caption_has_what_is_known_of_error_and_surface() -> None:
    row = Row("k", "chair", "v4", 64, "Ours", 1.5, 0.8, 0.9, 0.9, 0.1, 10,
              regions=Regions(0.25, 0.5, 0.125, 0.25, 0.25, 0.125),
              surface=SurfaceFigures(0.5, 20.0, 0.75, 0.8, 0.7, 0.9, math.nan, 0.6, 0.7))
    assert caption(row) == ("MAD 1.50 mm, seen 0.88, unseen 0.62\n"
                            "F 0.75, Chamfer 0.50 voxels\nnormals 0.90")
    thin = replace(row.surface, recall_thin=0.4)
    assert caption(replace(row, surface=thin)).endswith("normals 0.90, thin 0.40")
    assert caption(replace(row, regions=Regions(), surface=SurfaceFigures())) == "MAD 1.50 mm"
    assert caption(replace(row, mad_mm=math.nan, regions=Regions(), surface=SurfaceFigures())) == ""
