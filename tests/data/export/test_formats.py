"""What is exported is what was stored: volumes, points, distances and surfaces against known shapes."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.export import export_dataset, surface_points
from ocnf_data.export.settings import ExportFormat, ExportSettings
from ocnf_data.files.storage import Store
from ocnf_data.meshes import read_mesh
from ocnf_data.meshes.topology import is_watertight
from ocnf_data.octree import GridOctree
from ocnf_data.octree.triangles import cell_triangles

# Of a surface cut out of 64^3 voxels of 47 mm: linear interpolation of a curved field, and float16.
CLOSE = 0.002
N = 4000


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as file:  # pickles are refused by default
        return dict(file)


# ---- dense


@pytest.mark.parametrize("resolution", [32, 64])
def test_volumes_are_the_fields_that_were_stored(shapes: Store, tmp_path: Path, known: SimpleNamespace,
                                                 resolution: int) -> None:
    report = export_dataset(shapes.url, tmp_path / "out", "dense", splits=["test"], resolution=resolution)
    assert (report.written, report.kept, report.failures) == (1, 0, [])
    found = load(tmp_path / "out/test/box_2.npz")
    assert found.keys() == {"target", "v2-tsdf", "v2-histogram", "extent", "truncation"}
    assert found["target"].dtype == np.float32
    assert found["target"].shape == (1, resolution, resolution, resolution)
    np.testing.assert_allclose(found["target"], known.field(known.box, resolution), atol=1 / 2048)
    assert np.array_equal(found["v2-histogram"], known.histogram(resolution))
    assert (found["extent"], found["truncation"]) == (3.0, known.truncation(resolution))


def test_volumes_as_stored_have_the_dtypes_of_the_disk(shapes: Store, tmp_path: Path) -> None:
    for stored in (False, True):
        export_dataset(shapes.url, tmp_path / f"{stored}", "dense", limit=1, resolution=32, stored=stored)
    plain, raw = (load(tmp_path / f"{stored}/train/ball_1.npz") for stored in (False, True))
    assert raw["target"].dtype == raw["v2-tsdf"].dtype == np.float16
    assert raw["v2-histogram"].dtype == np.uint8
    assert np.array_equal(raw["target"].astype(np.float32), plain["target"])
    assert np.array_equal(raw["v2-histogram"] / np.float32(255), plain["v2-histogram"])


def test_one_variant_or_encoding(shapes: Store, tmp_path: Path) -> None:
    export_dataset(shapes.url, tmp_path / "out", "dense", limit=1, resolution=32, encoding="histogram")
    found = load(tmp_path / "out/train/ball_1.npz")
    assert found.keys() == {"target", "v2-histogram", "extent", "truncation"}
    report = export_dataset(shapes.url, tmp_path / "none", "dense", limit=1, variant="v9")
    assert {error.code for _, error in report.failures} == {"missing"}
    assert "v2-tsdf, v2-histogram" in str(report.failures[0][1])


# ---- points


@pytest.fixture
def points(shapes: Store, tmp_path: Path) -> Path:
    report = export_dataset(shapes.url, tmp_path / "out", "points", points=N, splits=["train"], limit=2)
    assert report.written == 2
    return tmp_path / "out"


@pytest.mark.parametrize("shape", ["ball", "box"])
def test_surface_points_lie_on_the_surface(points: Path, known: SimpleNamespace, shape: str) -> None:
    distance = getattr(known, shape)
    cloud = load(points / f"occupancy_networks/{shape}/{shape}_1/pointcloud.npz")
    assert cloud["points"].dtype == cloud["normals"].dtype == np.float32
    assert cloud["points"].shape == cloud["normals"].shape == (N, 3)
    metres = cloud["points"].astype(np.float64) * known.extent  # the unit cube
    off = np.abs(distance(metres))
    # Marching cubes cut a box's edges by up to about a voxel.
    assert off.max() < (CLOSE if shape == "ball" else 0.05)
    assert np.median(off) < CLOSE
    np.testing.assert_allclose(np.linalg.norm(cloud["normals"], axis=1), 1, atol=1e-5)
    step = 0.02
    ahead = distance(metres + step * cloud["normals"]) - distance(metres)
    assert np.median(ahead) > 0.99 * step  # outwards


def test_surface_points_are_spread_by_area(points: Path, known: SimpleNamespace) -> None:
    cloud = load(points / "occupancy_networks/ball/ball_1/pointcloud.npz")["points"] * known.extent
    direction = (cloud - [0.2, -0.1, 0.3]) / known.radius
    # Archimedes: each coordinate on a sphere is uniform in [-1, 1]; 4 standard errors, and some for the cut.
    for power, mean in ((1, 0), (2, 1 / 3), (4, 1 / 5)):
        assert np.abs((direction ** power).mean(axis=0) - mean).max() < 4 * 0.6 / N ** 0.5


def test_surface_points_are_uniform_on_every_triangle(known: SimpleNamespace) -> None:
    """Against closed forms of its moments, on a surface of 8^3 voxels: triangles of all sizes."""
    tsdf = GridOctree.from_dense(known.field(known.ball, 8))
    points, _ = surface_points(tsdf, 200_000, np.random.default_rng(3), known.extent)
    corners = cell_triangles(tsdf, known.extent).triangles.astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    assert area.max() > 10 * area[area > 0].min()
    total = corners.sum(axis=1)
    moments = {1: total / 3, 2: (total ** 2 + (corners ** 2).sum(axis=1)) / 12}
    for power, of_triangles in moments.items():
        expected = np.average(of_triangles, axis=0, weights=area)
        error = (points ** power).mean(axis=0) - expected
        assert (np.abs(error) < 4.5 * (points ** power).std(axis=0) / len(points) ** 0.5).all()


def test_loc_and_scale_lead_back_to_the_mesh_file(points: Path, known: SimpleNamespace) -> None:
    for name in ("occupancy_networks/ball/ball_1/pointcloud.npz", "occupancy_networks/ball/ball_1/points.npz",
                 "deepsdf/SdfSamples/ocnf/ball/ball_1.npz"):
        file = load(points / name)
        rows = file["neg"] if "neg" in file else file["points"]
        metres = rows[:, :3].astype(np.float64) * known.extent
        if "neg" in file:
            metres = metres / known.extent / file["truncation"] * known.truncation(64)
        in_file = rows[:, :3] * file["scale"] + file["loc"]
        np.testing.assert_allclose((in_file - known.centre) * known.scale, metres, atol=1e-5)


@pytest.mark.parametrize("shape", ["ball", "box"])
def test_occupancies_are_the_sign_of_the_distance(points: Path, known: SimpleNamespace, shape: str) -> None:
    file = load(points / f"occupancy_networks/{shape}/{shape}_1/points.npz")
    assert file["points"].shape == (N, 3)
    assert file["occupancies"].dtype == np.uint8
    inside = np.unpackbits(file["occupancies"])[:N] == 1  # as the reader does
    where = file["points"].astype(np.float64)
    assert 0.5 < np.abs(where).max() <= 0.55
    distance = getattr(known, shape)(where * known.extent)
    clear = np.abs(distance) > (CLOSE if shape == "ball" else 0.05)
    assert clear.mean() > 0.9
    assert np.array_equal(inside[clear], distance[clear] < 0)
    assert inside.sum() > 100


@pytest.mark.parametrize("shape", ["ball", "box"])
def test_signed_distances_are_those_of_the_shape(points: Path, known: SimpleNamespace, shape: str) -> None:
    file = load(points / f"deepsdf/SdfSamples/ocnf/{shape}/{shape}_1.npz")
    pos, neg = file["pos"], file["neg"]
    assert pos.dtype == neg.dtype == np.float32
    assert len(pos) + len(neg) == N and pos.shape[1] == neg.shape[1] == 4
    assert (pos[:, 3] >= 0).all() and (neg[:, 3] < 0).all() and len(neg) > N / 5
    rows = np.concatenate([pos, neg]).astype(np.float64)
    tau = known.truncation(64)
    rows *= tau / file["truncation"]  # in metres
    distance = getattr(known, shape)(rows[:, :3])
    assert np.abs(rows[:, 3]).max() <= tau * 1.0001
    # Between two voxels one of which is truncated, interpolation falls short.
    sharp = np.abs(distance) < tau / 2
    assert sharp.mean() > 0.3
    error = np.abs(rows[:, 3] - distance)[sharp]
    assert error.max() < (CLOSE if shape == "ball" else 0.03)
    assert np.median(error) < CLOSE
    far = (np.abs(distance) > 1.8 * tau) & (np.abs(rows[:, :3]).max(axis=1) < 1.4)
    np.testing.assert_allclose(np.abs(rows[far, 3]), tau, rtol=1e-5)


def test_the_unit_sphere_is_deepsdfs(points: Path, known: SimpleNamespace) -> None:
    file = load(points / "deepsdf/SdfSamples/ocnf/ball/ball_1.npz")
    farthest = np.linalg.norm([0.2, -0.1, 0.3]) + known.radius
    assert known.truncation(64) / file["truncation"] == pytest.approx(1.03 * farthest, abs=CLOSE)


def test_the_lists_of_either_project(points: Path) -> None:
    """Each finds its samples by them: CATEGORY/SPLIT.lst, and {set: {category: [names]}}."""
    assert (points / "occupancy_networks/ball/train.lst").read_text() == "ball_1"
    assert (points / "occupancy_networks/box/train.lst").read_text() == "box_1"
    assert sorted(path.name for path in (points / "occupancy_networks").iterdir()) == ["ball", "box"]
    listed = json.loads((points / "deepsdf/train.json").read_text())
    assert listed == {"ocnf": {"ball": ["ball_1"], "box": ["box_1"]}}


def test_points_in_metres(shapes: Store, tmp_path: Path, known: SimpleNamespace) -> None:
    export_dataset(shapes.url, tmp_path / "out", "points", points=500, splits=["train"], limit=1,
                   coordinates="metres")
    cloud = load(tmp_path / "out/occupancy_networks/ball/ball_1/pointcloud.npz")
    assert np.abs(known.ball(cloud["points"])).max() < CLOSE
    samples = load(tmp_path / "out/deepsdf/SdfSamples/ocnf/ball/ball_1.npz")
    assert samples["truncation"] == known.truncation(64)


# ---- mesh


def test_meshes_are_closed_and_on_the_surface(shapes: Store, tmp_path: Path, known: SimpleNamespace) -> None:
    pytest.importorskip("skimage")
    for coordinates, factor in (("metres", 1.0), ("unit-cube", 1 / 3)):
        out = tmp_path / coordinates
        export_dataset(shapes.url, out, "mesh", splits=["train"], limit=1, coordinates=coordinates)
        for name, radius in (("ball_1.ply", known.radius), ("ball_1.v2.ply", known.radius / 2)):
            mesh = read_mesh(out / "train" / name)
            assert is_watertight(mesh.faces)
            # The input is stored in steps of tau / 128.
            assert np.abs(known.ball(mesh.vertices / factor, radius)).max() < 2 * CLOSE
        assert {path.name for path in (out / "train").iterdir()} == {"ball_1.ply", "ball_1.v2.ply"}


# ---- vdb


class FakeGrid:
    """As much of `openvdb.FloatGrid` as is used."""

    def __init__(self, background: float) -> None:
        self.background = background

    def copyFromArray(self, array: np.ndarray) -> None:
        self.array = array.copy()


@pytest.fixture
def fake_openvdb(monkeypatch: pytest.MonkeyPatch) -> list[FakeGrid]:
    written: list[FakeGrid] = []

    def write(path: str, grids: list[FakeGrid]) -> None:
        written.extend(grids)
        Path(path).write_bytes(b"vdb")

    monkeypatch.setitem(sys.modules, "openvdb", SimpleNamespace(
        FloatGrid=FakeGrid, createLinearTransform=np.array, write=write,
        GridClass=SimpleNamespace(LEVEL_SET="level set", FOG_VOLUME="fog volume")))
    return written


def test_grids_lie_where_the_voxels_lie(shapes: Store, tmp_path: Path, known: SimpleNamespace,
                                        fake_openvdb: list[FakeGrid]) -> None:
    """With a stand-in: which index, which world position, which value, in metres."""
    export_dataset(shapes.url, tmp_path / "out", "vdb", splits=["test"], resolution=32)
    assert (tmp_path / "out/test/box_2.vdb").read_bytes() == b"vdb"
    assert [grid.name for grid in fake_openvdb] == ["target", "v2"]
    grid, tau = fake_openvdb[0], known.truncation(32)
    assert grid.gridClass == "level set" and grid.background == pytest.approx(tau)
    index = np.stack([*np.indices(grid.array.shape), np.ones(grid.array.shape)], -1)
    expected = np.clip(known.box((index @ grid.transform)[..., :3]), -tau, tau)
    np.testing.assert_allclose(grid.array, expected, atol=tau / 2000)


def test_occupancy_is_a_fog_volume(write_set, tmp_path: Path, known: SimpleNamespace,
                                   fake_openvdb: list[FakeGrid]) -> None:
    sample = known.sample("box_1", "box", known.box, "train", (32,), target="occupancy")
    store = write_set({"train": [[sample]]}, tmp_path / "occupancy")
    export_dataset(store.url, tmp_path / "out", "vdb")
    grid = fake_openvdb[0]
    assert (grid.gridClass, grid.background) == ("fog volume", 0)
    assert np.array_equal(grid.array.T, known.field(known.box, 32)[0] < 0)
    for format_ in ("points", "mesh"):
        report = export_dataset(store.url, tmp_path / format_, format_)
        assert [error.code for _, error in report.failures] == ["misfit"]
        assert "occupancy" in str(report.failures[0][1])


@pytest.mark.parametrize("target", ["tsdf", "occupancy"])
def test_a_grid_in_the_unit_sphere_is_fitted_to_the_surface(
        write_set, tmp_path: Path, known: SimpleNamespace, fake_openvdb: list[FakeGrid], target: str) -> None:
    """And a sample without one is a failure of its own, in the unit sphere alone."""
    samples = [known.sample(key, "box", distance, "train", (32,), target=target) for key, distance in
               (("box_1", known.box), ("none_1", lambda points: np.full(points.shape[:-1], 1.0)))]
    store = write_set({"train": [samples]}, tmp_path / "set")
    report = export_dataset(store.url, tmp_path / "out", "vdb", coordinates="unit-sphere")
    assert [(key, error.code) for key, error in report.failures] == [("none_1", "empty")]
    grid = fake_openvdb[0]
    inside = np.argwhere(grid.array < 0 if target == "tsdf" else grid.array > 0.5)
    places = np.concatenate([inside, np.ones((len(inside), 1))], axis=1) @ grid.transform
    assert np.linalg.norm(places[:, :3], axis=1).max() == pytest.approx(1 / 1.03, abs=0.08)
    assert export_dataset(store.url, tmp_path / "metres", "vdb").written == 2


def test_without_openvdb_the_error_says_how_to_get_it(shapes: Store, tmp_path: Path,
                                                      monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("openvdb", "pyopenvdb"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(OcnfError, match="conda install -c conda-forge openvdb") as caught:
        export_dataset(shapes.url, tmp_path / "out", "vdb")
    assert caught.value.code == "missing_extra"
    assert not (tmp_path / "out").exists()


def test_a_vdb_file_holds_the_distances(shapes: Store, tmp_path: Path, known: SimpleNamespace) -> None:
    try:
        import openvdb
    except ImportError:
        openvdb = pytest.importorskip("pyopenvdb", reason="OpenVDB's Python module is not installed")
    export_dataset(shapes.url, tmp_path / "out", "vdb", splits=["test"], resolution=32)
    grids, _ = openvdb.readAll(str(tmp_path / "out/test/box_2.vdb"))
    grid = next(grid for grid in grids if grid.name == "target")
    assert grid.gridClass == openvdb.GridClass.LEVEL_SET
    tau, accessor = known.truncation(32), grid.getConstAccessor()
    for index in np.random.default_rng(0).integers(0, 32, (500, 3)).tolist():
        expected = np.clip(known.box(np.array(grid.transform.indexToWorld(index))), -tau, tau)
        assert accessor.getValue(tuple(index)) == pytest.approx(expected, abs=tau / 2000)


# ---- settings


@pytest.mark.parametrize(("wrong", "field"), [
    ({"format": "obj"}, "format"), ({"coordinates": "feet"}, "coordinates"), ({"points": 0}, "points"),
    ({"encoding": "sdf"}, "encoding"), ({"format": "points", "variant": "v2"}, "variant"),
    ({"format": "mesh", "encoding": "histogram"}, "encoding"), ({"format": "dense", "points": 9}, "points"),
    ({"format": "dense", "coordinates": "metres"}, "coordinates"),
    ({"format": "vdb", "stored": True}, "stored"),
])
def test_settings_that_do_not_fit_are_named(wrong: dict, field: str) -> None:
    with pytest.raises(OcnfError) as caught:
        ExportSettings(**{"format": ExportFormat.POINTS, **wrong})
    assert caught.value.field == field
