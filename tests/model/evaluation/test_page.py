"""The page of an evaluation: its figures are the rows', its surfaces those of the methods."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_model import OctNetFusion, OctreeBatch
from ocnf_model.baselines import tvl1
from ocnf_model.cli import app
from ocnf_model.evaluation.methods import default_weight
from ocnf_model.evaluation.page import EvaluationPage
from ocnf_model.evaluation.run import Evaluation, evaluate, run_evaluate

if TYPE_CHECKING:
    from playwright.sync_api import Browser

EXTENT = 3.0


class Shown(NamedTuple):
    found: Evaluation
    path: Path
    page: dict[str, Any]
    sample: Callable[[int], tuple[dict[str, np.ndarray], dict[str, Any]]]


@pytest.fixture(scope="module")
def shown(tiny: str, network: OctNetFusion, tmp_path_factory: pytest.TempPathFactory,
          read_page: Callable) -> Shown:
    """A model, two variants, three methods."""
    path = tmp_path_factory.mktemp("page") / "page.html"
    page = EvaluationPage(path, tiny, "test", None, "z", triangles=10**6)
    found = evaluate(network, tiny, page=page, limit=1)
    assert page.finish(found.title, found.summaries, found.ceilings, found.notes) == [path]
    return Shown(found, path, *read_page(path))


def test_every_model_of_every_variant_has_its_figures(shown: Shown) -> None:
    rows = {(row.key, row.variant, row.method): row for row in shown.found.rows if row.resolution == 64}
    names = [column["label"] for column in shown.page["columns"]]
    assert names == [f"{method} {figure}" for method in ("VolFus", "VolFus*", "TV-L1", "Ours")
                     for figure in ("MAD", "F-score")]
    keys = {row.key for row in shown.found.rows}
    assert {sample["key"] for sample in shown.page["samples"]} == {
        f"{key} ({variant})" for key in keys for variant in ("v4", "v2")}
    for sample in shown.page["samples"]:
        key, variant = sample["key"][:-1].split(" (")
        assert sample["split"] == variant and shown.page["group"] == "Input"
        for name, value in zip(names, sample["values"], strict=True):
            method, figure = name.split(" ")
            row = rows.get((key, variant, method))
            true = None if row is None else row.mad_mm if figure == "MAD" else row.surface.f_score
            assert value == true or (value is None and np.isnan(true))
    assert shown.page["failures"]["rows"] == []


def test_surfaces_are_those_of_the_methods(shown: Shown, network: OctNetFusion,
                                           members: Callable[[str, str], GridOctree]) -> None:
    compared = 0
    for number, sample in enumerate(shown.page["samples"]):
        key, variant = sample["key"][:-1].split(" (")
        arrays, meta = shown.sample(number)
        names = [one["name"] for one in meta["shown"]]
        volfus = "VolFus" if variant == "v4" else "VolFus*"
        assert names == ["Mesh", "Noisy input", volfus, "TV-L1", "Ours", "Ground truth"]
        assert meta["first"] == ["Ours", "Ground truth"]
        assert [one["name"] for one in meta["slices"]] == names[2:]
        histograms = [members(key, f"{variant}-histogram-{resolution}") for resolution in (32, 64)]
        ours = network([OctreeBatch.from_grids([one]) for one in histograms])[-1]
        true = {"TV-L1": tvl1(histograms[-1], default_weight(64)), "Ours": ours.to_grids()[0],
                "Ground truth": members(key, "target-64")}
        if variant == "v4":
            true["VolFus"] = members(key, "v4-tsdf-64")
        for name, octree in true.items():
            at = names.index(name)
            octree = octree.with_data(octree.data.clip(-1, 1))
            vertices, faces = octree_surface(octree, EXTENT)
            assert meta["shown"][at]["of"] == len(faces)
            assert len(arrays[f"surface{at}/faces"]) == len(faces)
            found = (arrays[f"surface{at}/positions"] / 65535 - 0.5) * EXTENT
            used = vertices[np.unique(faces)] if len(faces) else vertices
            assert len(found) == len(used) and (len(used) > 0 or name == "Ours")
            if len(used):
                assert cKDTree(used).query(found)[0].max() < EXTENT / 65535
            compared += 1
    assert compared == 4 + 3


def test_tables_are_the_means(shown: Shown) -> None:
    for table, by in zip(shown.page["tables"], ("all", "category") * 2, strict=True):
        variant = table["title"].split(":")[0]
        for first, method, n, mad, *_ in table["rows"]:
            [summary] = [one for one in (*shown.found.summaries, *shown.found.ceilings)
                         if (one.variant, one.method) == (variant, method)
                         and (one.category == "all" and f"{one.resolution}³" == first if by == "all"
                              else one.category == first and one.resolution == 64)]
            assert (n, mad) == (summary.n_models, summary.mad_mm)


def test_a_model_that_cannot_be_shown_costs_nothing_else(tiny: str, tmp_path: Path, read_page: Callable,
                                                         monkeypatch: pytest.MonkeyPatch) -> None:
    from ocnf_model.evaluation import page as module

    def fail(sample: Any, *arguments: Any, **options: Any) -> Any:
        if "chair" in sample.key:
            raise OcnfError("the mesh is lost", code="missing", where=sample.key)
        return made(sample, *arguments, **options)

    made = module.make_picture
    monkeypatch.setattr(module, "make_picture", fail)
    found = run_evaluate("pretrained", tiny, methods=["volfus"], html=tmp_path / "page.html", out=tmp_path,
                         n_figures=0)
    page, _ = read_page(tmp_path / "page.html")
    lost = [row for row in page["failures"]["rows"] if "the mesh is lost" in row[2]]
    assert len(lost) + len(page["samples"]) == len(found.rows) / 2 and lost and page["samples"]
    assert any("could not be shown" in note for note in page["notes"])
    assert (tmp_path / "evaluation.md").is_file()


def test_a_place_that_cannot_be_written_is_said_at_once(tiny: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for html in (tmp_path / "file" / "page.html", tmp_path / "page.txt"):
        done = CliRunner().invoke(app, ["evaluate", "pretrained", tiny, "--out", str(tmp_path / "out"),
                                        "--html", str(html)])
        assert isinstance(done.exception, OcnfError) and str(tmp_path) in str(done.exception)
        assert "MAD" not in done.output and not (tmp_path / "out").exists()


def test_it_opens_and_swaps_all_methods(shown: Shown, browser: Browser) -> None:
    tab, wrong = browser.new_page(viewport={"width": 1200, "height": 800}), []
    tab.on("console", lambda message: wrong.append(message.text)
           if message.type in ("error", "warning") else None)
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.goto(shown.path.as_uri())
    assert tab.is_visible("#split") and tab.inner_text("#group") == "Input"
    tab.select_option("#split", "v4")
    assert tab.locator(".card").count() == 1
    tab.click(".card >> nth=0")
    tab.wait_for_selector("html[data-sample]")
    assert tab.locator("[data-surface]").all_inner_texts() == [
        "Mesh", "Noisy input", "VolFus", "TV-L1", "Ours", "Ground truth"]
    assert tab.get_attribute("[data-surface='Ours']", "aria-pressed") == "true"
    tab.click("[data-layout='all']")
    tab.wait_for_selector("#panes b >> nth=5")
    assert wrong == []
    tab.close()
