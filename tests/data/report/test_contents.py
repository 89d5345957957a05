"""What is on the page is what is in the data set: decoded from the file, and computed again."""

from __future__ import annotations

import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from ocnf_data.manifest import Manifest
from ocnf_data.meshes.read import read_mesh
from ocnf_data.octree import GridOctree, decode
from ocnf_data.octree.surface import octree_surface
from ocnf_data.report.blob import pack
from ocnf_data.report.deviation import Deviation
from ocnf_data.report.geometry import Triangles, drawn_on, ordered, simplify
from ocnf_data.shards.dataset import load_dataset

EXTENT = 3.0
HALF_STEP = EXTENT / 65535 / 2


@pytest.fixture(scope="module")
def shown(report_made: Any, read_page: Callable) -> dict[str, tuple[dict, dict]]:
    """Arrays and the rest of every sample, by key."""
    page, sample = read_page(report_made.page)
    return {row["key"]: sample(number) for number, row in enumerate(page["samples"])}


def members(data: Path) -> dict[str, bytes]:
    found = {}
    for path in sorted(data.glob("*/*.tar")):
        with tarfile.open(path) as tar:
            found |= {entry.name: tar.extractfile(entry).read() for entry in tar}
    return found


def surface(arrays: dict[str, np.ndarray], meta: dict[str, Any], name: str) -> tuple[np.ndarray, np.ndarray]:
    number = [one["name"] for one in meta["shown"]].index(name)
    return (arrays[f"surface{number}/positions"] / 65535 - 0.5) * EXTENT, arrays[f"surface{number}/faces"]


def same_triangles(found: tuple[np.ndarray, np.ndarray], true: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether two meshes are one, but for the order of their parts and the rounding of positions."""
    a, b = (np.asarray(vertices)[faces] for vertices, faces in (found, true))
    if len(a) != len(b):
        return False
    # Each triangle as its corners in cyclic order from each corner: one of the three has to be near.
    turned = np.concatenate([np.roll(b, turn, axis=1) for turn in range(3)]).reshape(-1, 9)
    distance, nearest = cKDTree(turned).query(a.reshape(-1, 9))
    return bool(distance.max() <= 3 * HALF_STEP * 1.001) and len(set(nearest % len(b))) > 0.99 * len(b)


def test_surfaces_are_those_of_the_octrees(report_made: Any, shown: dict) -> None:
    stored = members(report_made.data)
    for key, (arrays, meta) in shown.items():
        for name, member in (("Ground truth", "target-32"), ("VolFus", "v3-tsdf-32")):
            true = octree_surface(decode(stored[f"{key}.{member}.oct"]), EXTENT)
            assert same_triangles(surface(arrays, meta, name), true), (key, name)
            assert not same_triangles(surface(arrays, meta, name), (true[0] + 4 * HALF_STEP, true[1]))


def test_the_mesh_is_the_one_that_was_read(report_made: Any, shown: dict) -> None:
    for key, (arrays, meta) in shown.items():
        category, name = key.split("-")
        mesh = read_mesh(report_made.meshes / category / f"{name}.ply")
        vertices, _ = surface(arrays, meta, "Mesh")
        # Normalised: moved and scaled by one number, so that the shape stays.
        box = np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0)
        ratio = np.ptp(vertices, axis=0) / box
        assert np.ptp(ratio) < 1e-3 * ratio.mean()
        assert len(arrays["surface0/faces"]) == len(mesh.faces)


def test_points_are_where_the_views_measured_them(report_made: Any, shown: dict) -> None:
    """Each point projects onto the middle of a pixel of some view, at the depth that the view saw there."""
    from ocnf_data.generation.remake import remake
    from ocnf_data.shards.browse import find_sample

    manifest = Manifest.from_dict(load_dataset(str(report_made.data)).manifest)
    for key, (arrays, _) in shown.items():
        facts = find_sample(str(report_made.data), key).facts
        views = remake(manifest, facts, report_made.meshes).observed["v3"]
        points = (arrays["surface1/positions"] / 65535 - 0.5) * EXTENT
        inside = (np.abs(points) < EXTENT / 2 - 2 * HALF_STEP).all(axis=1)  # others were moved to the border
        explained = np.zeros(len(points), bool)
        for depth, K, R, T in zip(views.depth, views.K, views.R, views.T, strict=True):
            seen = points @ R.T + T
            u, v, z = (seen @ K.T).T
            column, row = np.rint(u / z).astype(int), np.rint(v / z).astype(int)
            ok = (z > 0) & (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
            there = np.full(len(points), np.nan)
            there[ok] = depth[row[ok], column[ok]]
            is_middle = np.maximum(np.abs(u / z - column), np.abs(v / z - row)) < 0.01
            explained |= is_middle & (np.abs(there - z) < 1e-3)
        assert inside.sum() > 100 and explained[inside].all()
        n = int((np.isfinite(views.depth) & (views.depth > 0)).sum())
        assert len(points) == min(n, 12_000)


def nearest_distance(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """From each point to the nearest of all triangles, none left out."""
    def nearest(point: np.ndarray) -> float:
        on = trimesh.triangles.closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
        return float(np.linalg.norm(point - on, axis=1).min())

    return np.array([nearest(point) for point in points])


def test_error_colours_are_distances_to_the_ground_truth(report_made: Any, shown: dict) -> None:
    stored = members(report_made.data)
    limit = 3 * EXTENT / 32
    for key, (arrays, meta) in list(shown.items())[:2]:
        vertices, faces = octree_surface(decode(stored[f"{key}.target-32.oct"]), EXTENT)
        for number, one in enumerate(meta["shown"]):
            assert (f"surface{number}/error" in arrays) == one["hasError"]
            assert one["hasError"] == (one["name"] in ("VolFus", "Noisy input"))
            if one["hasError"]:
                chosen = np.random.default_rng(0).choice(len(arrays[f"surface{number}/positions"]), 60)
                points = (arrays[f"surface{number}/positions"][chosen] / 65535 - 0.5) * EXTENT
                inside = (np.abs(points) < EXTENT / 2 - 2 * HALF_STEP).all(axis=1)
                true = nearest_distance(points, vertices[faces]).clip(0, limit)
                found = arrays[f"surface{number}/error"][chosen] / 255 * limit
                assert inside.sum() > 40
                np.testing.assert_allclose(found[inside], true[inside], atol=limit / 510 + 2 * HALF_STEP)


def test_slices_are_planes_of_the_dense_volumes(report_made: Any, shown: dict) -> None:
    stored = members(report_made.data)
    for key, (arrays, meta) in shown.items():
        assert [one["name"] for one in meta["slices"]] == ["VolFus", "Ground truth"]
        for number, (one, member) in enumerate(zip(meta["slices"], ("v3-tsdf-32", "target-32"), strict=True)):
            octree = decode(stored[f"{key}.{member}.oct"])
            plane = int(one["title"].split("y = ")[1].split(":")[0])
            dense = np.clip(octree.to_dense()[0][:, plane], -1, 1)
            image = np.full(dense.shape, np.nan)
            for (row, column, width), value in zip(arrays[f"slice{number}/squares"],
                                                   arrays[f"slice{number}/values"], strict=True):
                assert np.isnan(image[row : row + width, column : column + width]).all()
                image[row : row + width, column : column + width] = value / 127.5 - 1
            np.testing.assert_allclose(image, dense, atol=1 / 255 + 1e-6)
            assert (one["up"], one["right"]) == ("z", "x") and f"{octree.n_leaves:,} leaves" in one["title"]


def test_depth_maps_are_pictures_of_every_view(shown: dict) -> None:
    for arrays, meta in shown.values():
        assert len(meta["depths"]) == 4 and "without noise" in meta["depths"][0]["title"]
        for number, one in enumerate(meta["depths"]):
            picture = cv2.imdecode(arrays[f"depth{number}"].astype(np.uint8), cv2.IMREAD_COLOR)
            assert picture.shape == (60, 80, 3) and picture.std() > 5
            assert 0 < one["limits"][0] < one["limits"][1] < 10


def test_facts_counts_and_failures(report_made: Any, read_page: Callable) -> None:
    page, _ = read_page(report_made.page)
    stored = members(report_made.data)
    facts = dict(page["facts"])
    assert (facts["inputs"], facts["samples"], facts["failures"]) == ("4", "3", "1")
    by_category, _, kinds = page["tables"]
    assert [row[:3] for row in by_category["rows"]] == [["chair", 1, 1], ["mug", 2, 2], ["all", 3, 3]]
    sizes = {row[0]: (row[1], row[2]) for row in kinds["rows"]}
    for member, (count, megabytes) in sizes.items():
        parts = [len(data) for name, data in stored.items() if name.endswith(f".{member}")]
        assert count == len(parts) == 3 and megabytes == pytest.approx(sum(parts) / 1e6)
    [failure] = page["failures"]["rows"]
    assert "broken" in failure[0] and failure[1] == "read" and failure[3]
    for row in page["samples"]:
        size, triangles, coverage, leaves, error = row["values"]
        assert size == pytest.approx(sum(len(data) for name, data in stored.items()
                                         if name.startswith(f"{row['key']}.")) / 1e3)
        truth = decode(stored[f"{row['key']}.target-32.oct"])
        assert leaves == pytest.approx(100 * truth.n_leaves / 32**3) and 0 < coverage < 100 and error > 0
        assert row["source"].endswith(f"{row['key'].split('-')[1]}.ply") and triangles > 0
    means = [np.mean([row["values"][column] for row in page["samples"]]) for column in range(5)]
    np.testing.assert_allclose(by_category["rows"][-1][3:], means)


def test_fewer_triangles_change_the_picture_but_no_figure(report_made: Any, read_page: Callable,
                                                          tmp_path: Path) -> None:
    from ocnf_data.report.run import write_report

    write_report(str(report_made.data), tmp_path / "few.html", meshes=report_made.meshes, triangles=300)
    full, _ = read_page(report_made.page)
    few, sample = read_page(tmp_path / "few.html")
    assert [row["values"] for row in few["samples"]] == [row["values"] for row in full["samples"]]
    arrays, meta = sample(0)
    for number, one in enumerate(meta["shown"]):
        if one["kind"] == "surface":
            assert len(arrays[f"surface{number}/faces"]) == one["triangles"] <= 320 < one["of"]


# ---- the parts


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_ordering_keeps_every_triangle(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-1.5, 1.5, (rng.integers(3, 40), 3))
    faces = rng.integers(0, len(vertices), (n, 3))
    kept = ordered(Triangles(vertices, faces))

    def turned(triangles: np.ndarray) -> list[list]:
        return sorted(min(np.roll(one, k, axis=0).tolist() for k in range(3)) for one in triangles)

    assert turned(vertices[faces]) == turned(kept.vertices[kept.faces])
    assert len(kept.vertices) == len(np.unique(faces))


@given(seed=st.integers(0, 2**32 - 1))
def test_what_is_packed_comes_out(decode_blob: Callable, seed: int) -> None:
    rng = np.random.default_rng(seed)
    arrays = {f"{kind}{n}": rng.integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)
              for kind in (np.dtype("uint8"), np.dtype("uint16"), np.dtype("uint32"))
              for n, shape in enumerate([(rng.integers(0, 9), 3), (rng.integers(0, 9),)])}
    found, meta = decode_blob(pack(arrays, {"name": "π <"}))
    assert meta == {"name": "π <"} and found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name].reshape(array.shape), array)


def test_nothing_but_small_numbers_is_packed() -> None:
    with pytest.raises(TypeError, match="float32"):
        pack({"a": np.zeros(3, np.float32)}, None)


def test_points_are_drawn_evenly() -> None:
    """Of two squares, one four times as large as the other, the large one gets four fifths."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    vertices = np.concatenate([square, 2 * square + [5, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    points = drawn_on(Triangles(vertices, faces), 20_000)
    large = points[:, 0] > 3
    assert abs(large.mean() - 0.8) < 0.01 and np.abs(points[:, 2]).max() == 0
    np.testing.assert_allclose(points[large].mean(axis=0), [6, 1, 0], atol=0.02)
    np.testing.assert_allclose(points[~large].mean(axis=0), [0.5, 0.5, 0], atol=0.02)


def test_nothing_is_known_of_an_empty_ground_truth() -> None:
    empty = Triangles(np.empty((0, 3)), np.empty((0, 3), np.int64))
    assert np.isnan(Deviation(empty)(np.zeros((2, 3)))).all()
    assert len(ordered(empty).vertices) == 0 and simplify(empty, 10) == empty


def test_distances_are_exact_near_a_surface() -> None:
    sphere = trimesh.creation.icosphere(3)
    points = np.random.default_rng(1).normal(size=(200, 3))
    points *= np.random.default_rng(2).uniform(0.7, 1.4, (200, 1)) / np.linalg.norm(points, axis=1)[:, None]
    found = Deviation(Triangles(np.asarray(sphere.vertices), np.asarray(sphere.faces)))(points)
    np.testing.assert_allclose(found, nearest_distance(points, np.asarray(sphere.triangles)), atol=1e-9)


def test_a_solid_octree_has_no_ground_truth_beside_it(tmp_path: Path) -> None:
    from ocnf_data.encodings import Encoding
    from ocnf_data.report.contents import Contents, Scale, signed_surface

    free = GridOctree.from_dense(np.ones((1, 8, 8, 8), np.float32))
    nothing = signed_surface(free, Encoding.TSDF, 3.0)
    contents = Contents(Scale(3.0, 0.375, 1.0, 100), Deviation(nothing))
    assert contents.surface("nothing", nothing) is None
