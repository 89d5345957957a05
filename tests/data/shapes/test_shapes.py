"""Procedural shapes: always the same, always valid, never two alike, and as messy as they are meant to be."""

import json
import subprocess
import sys

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ocnf_data.errors import OcnfError
from ocnf_data.meshes import normalise
from ocnf_data.meshes.topology import is_watertight
from ocnf_data.render import render_depth
from ocnf_data.shapes import CATEGORIES, make_shape
from ocnf_data.shapes.draw import Draw
from ocnf_data.shapes.hollow import hollow
from ocnf_data.shapes.primitives import (
    Part,
    bevel_box,
    box,
    cushion,
    ellipse,
    frustum,
    loft,
    revolve,
    stack,
    tube,
)
from ocnf_data.shapes.rings import _band, _pipe
from ocnf_data.shapes.solids import ball, block, boulder
from ocnf_data.views import rigs

COUNT = 25
OPEN = ("basket", "bathtub", "bowl", "box", "bucket", "cup", "glass", "mug", "pitcher", "pot", "vase")
GOLDEN = {
    "airplane": "bd1843b0a332", "ball": "1a6162fc500b", "basket": "542c22bfb752", "bathtub": "320566f0fcbc",
    "bed": "de217a035a7b", "block": "96ce48bc5bac",
    "bottle": "48d11c72d06d", "boulder": "16d8a257e695", "bowl": "2dc8e8727832",
    "box": "8206511c7100", "bucket": "bb5685219e37", "car": "333c7c33b1c4",
    "chair": "a43a844a5c03", "cup": "675dcd25a593", "desk": "c9415305f71e",
    "fence": "8f4fd4692ff5", "glass": "7ce68af354ff", "guitar": "fa882a6a7334",
    "knot": "3a31261661ff", "ladder": "e2e5fed5bec7", "lamp": "d4998ea97eaa",
    "monitor": "a5cbb64365ef", "mug": "47b5e40b98a9", "pipe": "9f6ad4a826c9",
    "pitcher": "ac4d3da835b5", "plant": "6edbcc44ab5a", "pole": "3083c4f5811c",
    "pot": "bdd0790e60f6", "rack": "73a816e224dc", "ring": "e7df0e671a4f",
    "shelf": "e6a4dd76e77d", "sofa": "cf5000559ab4", "stool": "c2d5475f6cf6",
    "table": "40440a46d14d", "vase": "c55459e36a5a", "wheel": "661a3566e495",
}  # fmt: skip


@pytest.fixture(scope="module")
def shapes():
    return {(c, i): make_shape(c, 0, i, "train") for c in CATEGORIES for i in range(COUNT)}


def test_at_least_ten_categories():
    assert len(CATEGORIES) >= 10
    assert {"chair", "table", "desk", "lamp", "bed", "shelf", "monitor", "airplane", "mug"} <= set(CATEGORIES)


def test_every_shape_is_valid(shapes):
    for key, mesh in shapes.items():
        assert np.isfinite(mesh.vertices).all(), key
        assert 100 <= len(mesh.faces) <= 20_000, key
        np.testing.assert_array_equal(np.unique(mesh.faces), np.arange(len(mesh.vertices)), err_msg=str(key))
        size = np.ptp(mesh.vertices, axis=0)
        assert size.max() < 8 * size[size.argsort()[1]], key  # neither a needle
        assert 0.02 < size.max() < 100, key  # nor a mountain: metres
        assert mesh.stats["degenerate_faces"] < 0.05 * len(mesh.faces), key
        assert np.abs(mesh.vertices - np.round(mesh.vertices, 6)).max() < 1e-12, key


def test_no_two_are_alike(shapes):
    assert len({mesh.sha256 for mesh in shapes.values()}) == len(shapes)
    for category in CATEGORIES:  # the topology varies, not just the measures
        faces = {len(shapes[category, i].faces) for i in range(COUNT)}
        assert len(faces) > COUNT // 4, category


def test_each_part_of_the_key_counts():
    one = make_shape("chair", 0, 3, "train")
    assert one.sha256 == make_shape("chair", 0, 3, "train").sha256
    for other in (("chair", 1, 3, "train"), ("chair", 0, 4, "train"), ("chair", 0, 3, "test")):
        assert make_shape(*other).sha256 != one.sha256


def test_another_process_makes_the_same():
    """Neither the hash seed, nor what was made before, nor the thread count matters."""
    code = ("import json; from ocnf_data.shapes import *; "
            "print(json.dumps([make_shape(c, 5, 2, 'test').sha256 for c in reversed(CATEGORIES)]))")
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True,
                         env={"PYTHONHASHSEED": "7", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"})
    assert json.loads(out.stdout) == [make_shape(c, 5, 2, "test").sha256 for c in reversed(CATEGORIES)]


def test_golden_shapes():
    """Guards against a change of numpy's Philox and against changes of the shapes that nobody meant."""
    found = {c: make_shape(c, 0, 0, "train").sha256[:12] for c in CATEGORIES}
    assert found == GOLDEN


def test_winding_is_inconsistent_in_most_and_consistent_in_some(shapes):
    """Where an edge has two faces, both running the same way along it means that one is wound wrongly."""
    bad = []
    for mesh in shapes.values():
        a, b = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
        directed = a * len(mesh.vertices) + b
        bad.append(1 - len(np.unique(directed)) / len(directed))
    assert 0.7 < np.mean(np.array(bad) > 0.005) < 0.95
    assert max(bad) < 0.5


def test_open_and_closed_and_in_many_pieces(shapes):
    assert 0.1 < np.mean([m.stats["watertight"] for m in shapes.values()]) < 0.9
    assert np.median([m.stats["components"] for m in shapes.values()]) > 5


def test_hidden_insides(shapes):
    """In a good share of the shapes some component can be taken away without any camera noticing."""
    R, T = rigs.look_from(rigs.icosphere(1), 3.0)
    K = rigs.intrinsics(70, 70, 47.5, 47.5)
    hidden = []
    for category in CATEGORIES:
        mesh = shapes[category, 1]
        points, _ = normalise(mesh)
        depth = render_depth(points, mesh.faces, K, R, T, size=(96, 96))
        _, label = connected_components(coo_matrix((np.ones(3 * len(mesh.faces)), (
            mesh.faces.ravel(), np.roll(mesh.faces, 1, axis=1).ravel())), shape=[len(points)] * 2))
        of_face = label[mesh.faces[:, 0]]
        rest = (of_face != k for k in np.unique(of_face)[::-1][:15])
        hidden.append(any(np.array_equal(depth, render_depth(points, mesh.faces[r], K, R, T, size=(96, 96)))
                          for r in rest if r.any()))
    assert np.mean(hidden) > 0.4


def _volume(part: Part) -> float:
    a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


@pytest.mark.parametrize(("part", "volume"), [
    (box(1, 2, 3), 6),
    (frustum(1, 1, 2, 200), 2 * np.pi),
    (frustum(1, 0.5, 3, 200), np.pi * (1 + 0.5 + 0.25)),
    (cushion(2, 2, 2, 2, 120), 4 / 3 * np.pi),
    (tube([(0, 0, 0), (0, 0, 5)], 0.5, 200), 5 * np.pi / 4),
    (revolve([(0, 0), (1, 0), (1, 1), (0, 1)], 200), np.pi),
    (bevel_box(1, 1, 1, 1e-6), 1),
    (box(1, 2, 3).scale(x=-1, z=2), 12),
    (box(1, 2, 3).turn("x", 77).turn("z", 12).move(5, 6, 7), 6),
    (tube([(np.cos(t), np.sin(t), 0) for t in np.arange(200) * 2 * np.pi / 200], 0.1, 60, loop=True),
     2 * np.pi**2 * 0.01),
])
def test_primitives_enclose_their_volume(part, volume):
    """Closed and wound outwards: the signed volume is that of the solid."""
    assert is_watertight(part.faces)
    assert _volume(part) == pytest.approx(volume, rel=3e-3)


def _cone_volume(r0, r1, h):
    return np.pi / 3 * h * (r0 * r0 + r0 * r1 + r1 * r1)


@pytest.mark.parametrize(("r0", "r1", "h", "wall"), [(1, 1, 2, 0.1), (0.5, 1.2, 1, 0.05), (1, 0.7, 3, 0.2)])
def test_a_hollow_vessel_encloses_its_wall_and_nothing_else(r0, r1, h, wall):
    """Watertight, wound outwards, and its volume is the outside's less the cavity's (and the lip's)."""
    heights = np.linspace(0, h, 40)
    vessel = hollow(np.linspace(r0, r1, 40), heights, wall, ellipse(1, 1, 300))
    assert is_watertight(vessel.faces)
    floor = r0 + (r1 - r0) * wall / h
    cavity = _cone_volume(floor - wall, r1 - wall, h - wall)
    lip = 0.4 * wall * 0.5 * np.pi * (r1**2 - (r1 - wall) ** 2)
    assert _volume(vessel) == pytest.approx(_cone_volume(r0, r1, h) - cavity + lip, rel=0.01)


def test_pipes_and_bands_enclose_their_walls():
    pipe = _pipe(np.array([(0, 0, 0), (0, 0, 3.0)]), 1.0, 0.2, 200)
    band = _band(1.0, 0.3, 0.5, 200)
    assert is_watertight(pipe.faces) and is_watertight(band.faces)
    assert abs(_volume(pipe)) == pytest.approx(np.pi * (1 - 0.64) * 3, rel=1e-3)
    assert _volume(band) == pytest.approx(np.pi * (1 - 0.49) * 0.5, rel=1e-3)


@pytest.mark.parametrize("build", [ball, block, boulder])
def test_solids_are_closed_and_fill_their_box(build):
    for i in range(COUNT):
        parts = build(Draw("solids", i))
        assert all(is_watertight(part.faces) for part in parts), i
        inside = max(_volume(part) for part in parts)
        corners = np.concatenate([part.vertices for part in parts])
        assert inside > 0.15 * np.ptp(corners, axis=0).prod(), i


@pytest.mark.parametrize("category", OPEN)
def test_open_vessels_are_open_at_the_top(category, shapes):
    """Seen straight from above, most of them (those without lids and contents) are deep in the middle."""
    deep = []
    for i in range(COUNT):
        mesh = shapes[category, i]
        low, high = mesh.vertices[:, 2].min(), mesh.vertices[:, 2].max()
        size = np.ptp(mesh.vertices[:, :2], axis=0).min()
        # One camera far above the origin, which all vessels stand around, looking down through one pixel.
        R = np.array([[[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]])
        depth = render_depth(mesh.vertices, mesh.faces, rigs.intrinsics(1, 1, 0, 0), R,
                             np.array([[0.013 * size, 0.007 * size, high + 1.0]]), size=(1, 1))[0, 0, 0]
        deep.append(high + 1 - depth < low + 0.5 * (high - low))
    assert np.mean(deep) > 0.5


def test_open_lofts_are_open():
    assert not is_watertight(loft(stack([ellipse(1, 1), ellipse(1, 1)], [0, 1])).faces)


def test_draw_covers_its_range():
    draw = Draw("a", 1)
    counts = [draw.count(2, 4) for _ in range(300)]
    assert set(counts) == {2, 3, 4}
    values = [draw.between(-1, 2) for _ in range(1000)]
    assert min(values) >= -1
    assert max(values) < 2
    assert np.mean(values) == pytest.approx(0.5, abs=0.15)
    assert Draw("ab", "c").between(0, 1) != Draw("a", "bc").between(0, 1)


def test_unknown_category():
    with pytest.raises(OcnfError, match=r"unicorn.*airplane"):
        make_shape("unicorn", 0, 0, "train")
