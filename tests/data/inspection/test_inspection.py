"""Choosing, drawing and tabulating samples; what is right in a data set is tested in tests/test_tools.py."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from ocnf_data.cli import app
from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import fuse_tsdf
from ocnf_data.generation import generate
from ocnf_data.generation.sample import render_item
from ocnf_data.inspection import show
from ocnf_data.inspection.check import check_sample, check_surface
from ocnf_data.inspection.choose import complete_key, pick, sample_keys
from ocnf_data.inspection.show import draw_sample
from ocnf_data.inspection.stats import collect, print_table
from ocnf_data.manifest import Manifest
from ocnf_data.meshes import normalise
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.octree import GridOctree
from ocnf_data.render.shade import best_azimuth, shade
from ocnf_data.shapes import make_shape
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.verify.summary import describe, fingerprint_lines, print_summary

N_VIEWS = 5


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(meshes, data set) of three mesh files."""
    folder = tmp_path_factory.mktemp("inspection")
    for name, category in (("a-model-of-a-chair", "chair"), ("b", "mug"), ("c", "mug")):
        (folder / "meshes" / category).mkdir(parents=True, exist_ok=True)
        mesh = make_shape(category, 0, len(name), "train")
        (folder / "meshes" / category / f"{name}.ply").write_bytes(
            WRITERS[".ply"](mesh.vertices, mesh.faces, None))
    manifest = Manifest.from_dict({
        "name": "own", "source": {"kind": "folder", "shares": {"train": 1.0}},
        "camera": {"rig": "fibonacci8", "width": 80, "height": 60, "fx": 44, "fy": 44, "cx": 40, "cy": 30},
        "resolutions": [16, 64], "inputs": [
            {"name": f"v5_{i}", "views": N_VIEWS, "sigma": 0.02 * i, "encodings": ["tsdf", "histogram"]}
            for i in range(3)]})
    assert generate(manifest, folder / "OUT", folder / "meshes", progress=False).samples == 3
    return folder / "meshes", folder / "OUT"


def test_any_part_that_is_one_samples_alone_will_do(made: tuple[Path, Path]) -> None:
    url = str(made[1])
    keys = sample_keys(url)
    assert sorted(keys) == ["chair-a-model-of-a-chair", "mug-b", "mug-c"]
    for part, key in (("mug-b", "mug-b"), ("MODEL", "chair-a-model-of-a-chair"), ("chair-", keys[0])):
        [sample] = pick(url, [part])
        assert sample.key == (key if part != "chair-" else "chair-a-model-of-a-chair")
    assert complete_key("ab", ["ab", "abc"]) == "ab" and complete_key("b", ["bc", "abc"]) == "bc"
    with pytest.raises(OcnfError, match=r"several samples are called like that; found mug-., mug-."):
        pick(url, ["mug"])
    with pytest.raises(OcnfError, match=r"no such sample.*such as mug-b") as error:
        pick(url, ["mug_b"])
    assert error.value.code == "missing"


def test_every_input_view_is_drawn_with_or_without_the_meshes(made: tuple[Path, Path], tmp_path: Path,
                                                              monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in's depth is that of the mesh, to within voxels, wherever both are seen."""
    meshes, out = made
    manifest = Manifest.from_dict(load_dataset(out).manifest)
    sample = pick(str(out), ["mug-b"])[0]
    drawn: list[list[np.ndarray]] = []
    monkeypatch.setattr(show, "draw_depth", lambda ax, depth, limits: drawn[-1].append(depth))
    for given in (meshes, None):
        drawn.append([])
        draw_sample(sample, manifest, tmp_path / "one.png", given, "v5_0")
    assert len(drawn[0]) == len(drawn[1]) == 1 + N_VIEWS
    for a, b in zip(*drawn, strict=True):
        both = np.isfinite(a) & np.isfinite(b)
        assert both.sum() > 100 and (np.isfinite(a) == np.isfinite(b)).mean() > 0.95
        assert np.median(np.abs(a[both] - b[both])) < 3 / 64
    assert cv2.imread(str(tmp_path / "one.png")).shape[1] > 1000
    with pytest.raises(OcnfError):
        draw_sample(sample, manifest, tmp_path / "two.png", tmp_path)  # asked for, and not there
    assert not (tmp_path / "two.png").exists()


def test_a_picture_says_when_a_slice_is_cropped(made: tuple[Path, Path], tmp_path: Path,
                                                monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.figure import Figure

    titles: list[str] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: titles.extend(
        ax.get_title() for ax in figure.axes))
    manifest = Manifest.from_dict(load_dataset(made[1]).manifest)
    draw_sample(pick(str(made[1]), ["mug-c"])[0], manifest, tmp_path / "one.png", None, "v5_1")
    assert sum("cropped: 32 of 64 voxels" in title for title in titles) == 2
    assert sum(title.startswith("input view") for title in titles) == N_VIEWS
    assert not any("cropped" in title for title in titles if "16³" in title)


@pytest.mark.parametrize("up", ["y", "z"])
def test_the_viewpoint_is_the_one_that_shows_most(up: str) -> None:
    """A plate that stands is seen from its broad side; an L-shape from where both walls are."""
    thin = np.array([2.0, 0.02, 2.0]) if up == "z" else np.array([2.0, 2.0, 0.02])
    corners = (np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2) * thin
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                      [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])
    best = best_azimuth(corners, faces, up)
    coverage = {azimuth: (shade(corners, faces, 96, azimuth, up=up, supersample=1) < 255).any(axis=2).mean()
                for azimuth in (best, 60.0, 120.0)}
    turned = best % 180
    assert min(turned, 180 - turned) <= 35 and coverage[best] >= max(coverage.values())
    assert best_azimuth(np.zeros((0, 3)), np.zeros((0, 3), int)) == 35.0


def test_tables_never_cut_a_number(made: tuple[Path, Path]) -> None:
    def lines(width: int, of: str) -> list[str]:
        console = Console(file=io.StringIO(), width=width, record=True)
        if of == "stats":
            print_table(columns, console)
        else:
            print_summary(describe(str(made[1])), console)
        return console.export_text().splitlines()

    columns = collect(str(made[1]), None, 0, mad=True)
    for of in ("stats", "info"):
        narrow, wide = lines(80, of), lines(400, of)
        assert all(len(line) <= 80 for line in narrow) and max(map(len, wide)) > 80 * (of == "stats")
        assert "…" not in "".join(narrow)
        numbers = {word for line in wide for word in line.split()
                   if word.replace("/", "").replace(".", "").isdigit()}
        assert numbers - {word for line in narrow for word in line.split()} == set()


def test_the_fingerprint_is_read_as_sentences() -> None:
    assert fingerprint_lines("f00d") == ["fingerprint f00d"]
    assert fingerprint_lines({"cpu": "A", "libraries": {"numpy": "2.0", "numba": "1"}}) == [
        "made with cpu: A", "made with libraries: numpy 2.0, numba 1"]


def test_the_ground_truth_of_an_occupancy_set_is_the_right_way_out(tmp_path: Path) -> None:
    """Its surface faces outwards and has no wall around the cube, and the check of it passes."""
    manifest = Manifest.from_dict({
        "name": "own", "source": {"kind": "shapes", "categories": ["mug"], "counts": {"train": 1}},
        "camera": {"rig": "fibonacci8", "width": 80, "height": 60, "fx": 44, "fy": 44, "cx": 40, "cy": 30},
        "resolutions": [32], "target": "occupancy",
        "inputs": [{"name": "v2", "views": 2, "encodings": ["tsdf"]}]})
    assert generate(manifest, tmp_path / "OUT", progress=False).samples == 1
    [sample] = pick(str(tmp_path / "OUT"), ["mug"])
    vertices, faces = show._surface(manifest, sample.octree("target-32.oct"))
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    assert 0 < (np.cross(a, b) * c).sum() / 6 < 3.0**3 / 2
    assert np.abs(vertices).max() < 1.5
    found = [one for one in check_sample(sample, manifest, None, 64, 0) if one.check == "surface"]
    assert found and all(one.ok for one in found), found


@pytest.mark.parametrize("category", ["rack", "fence", "lamp", "sofa"])
def test_what_the_grid_cannot_hold_is_not_asked_of_it_and_all_else_is(category: str) -> None:
    """Wires thinner than a voxel have no crossing; a fusion that lies elsewhere is wrong for every shape."""
    manifest = Manifest.from_dict({
        "name": "own", "source": {"kind": "shapes", "categories": [category], "counts": {"train": 1}},
        "camera": {"rig": "fibonacci20", "width": 320, "height": 240, "fx": 176, "fy": 176, "cx": 160,
                   "cy": 120},
        "resolutions": [64], "inputs": [{"name": "v2", "views": 2, "encodings": ["tsdf"]}]})
    mesh = make_shape(category, 0, 0, "test")
    views = render_item(manifest, normalise(mesh)[0], mesh)
    octree = fuse_tsdf(views, 64)
    said, ok = check_surface(octree, views, Encoding.TSDF, 3.0)
    assert ok, said
    moved = replace(views, T=views.T + views.R @ np.full(3, 1.5 * 3 / 64))  # 2.6 voxels
    said, ok = check_surface(octree, moved, Encoding.TSDF, 3.0)
    assert not ok, said
    hollow = np.where(octree.to_dense() < 1, 1, octree.to_dense())
    hollow[0, :4, :4, :4] = -1
    said, ok = check_surface(GridOctree.from_dense(hollow), views, Encoding.TSDF, 3.0)
    assert not ok, said


@pytest.mark.parametrize(("command", "said"), [
    (["stats", "{set}", "--out", "{tmp}/x.xyz"], "cannot be written in this format; found .xyz"),
    (["stats", "{set}", "--out", "{tmp}/dir.png"], "is a folder, not a file"),
    (["stats", "{set}", "--out", "{tmp}/file/x.png"], "x.png"),
    (["stats", "{set}", "--out", "{tmp}/plain"], "found no suffix"),
    (["show", "{set}", "--out", "{tmp}/file/x.png"], "x.png"),
    (["show", "{set}", "--out", "{tmp}/file"], "sample.png")])
def test_a_picture_that_cannot_be_written_is_said_first(command, said, made, tmp_path, monkeypatch) -> None:
    for name in ("collect", "draw"):
        monkeypatch.setattr(f"ocnf_data.inspection.stats.{name}", None)
    (tmp_path / "file").write_text("")
    (tmp_path / "dir.png").mkdir()
    result = CliRunner().invoke(app, [word.format(set=made[1], tmp=tmp_path) for word in command])
    assert result.exit_code == 1 and isinstance(result.exception, OcnfError) and said in str(result.exception)


def test_names_in_square_brackets_are_printed_as_they_are(made: tuple[Path, Path]) -> None:
    columns = {name: {"[br]": values["mug"], "all": values["all"]}
               for name, values in collect(str(made[1]), None, 0, False).items()}
    console = Console(file=io.StringIO(), width=100, record=True)
    print_table(columns, console)
    assert "[br]" in console.export_text()
