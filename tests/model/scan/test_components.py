"""Loose parts, decimation, and what is cut out near measurements only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from ocnf_data import fuse_tsdf, octree_surface
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid, default_truncation
from ocnf_data.views.scans import read_scan
from ocnf_model.scan.components import decimate, drop_loose, keep_vertices
from ocnf_model.scan.region import everything, observed
from ocnf_model.scan.seen import measured_trees


def spheres(radii: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Spheres side by side, 2 m apart, in an order that mixes their vertices."""
    both = trimesh.util.concatenate([
        trimesh.creation.icosphere(2, r).apply_translation([2 * i, 0, 0]) for i, r in enumerate(radii)])
    order = np.random.default_rng(0).permutation(len(both.vertices))
    number = np.argsort(order)
    return np.asarray(both.vertices)[order], number[np.asarray(both.faces)]


def test_parts_with_a_shorter_diagonal_are_dropped_and_counted() -> None:
    vertices, faces = spheres([0.5, 0.1, 0.3, 0.1, 0.29])
    kept, triangles, n = drop_loose(vertices, faces, 2 * 0.295 * np.sqrt(3))  # of the boxes around spheres
    assert n == 3 and set(np.rint(kept[:, 0] / 2).astype(int)) == {0, 2}
    assert len(triangles) == 2 * len(faces) // 5
    whole = {tuple(map(tuple, corners)) for corners in vertices[faces]}
    assert {tuple(map(tuple, corners)) for corners in kept[triangles]} <= whole


def test_the_largest_part_stays_however_small_and_nothing_is_dropped_of_nothing() -> None:
    vertices, faces = spheres([0.1, 0.2])
    kept, _, n = drop_loose(vertices, faces, 100.0)
    assert n == 1 and (np.abs(kept[:, 0] - 2) < 0.3).all()
    assert drop_loose(np.empty((0, 3)), np.empty((0, 3), np.int64), 1.0)[2] == 0


def test_a_decimated_sphere_is_that_sphere_with_fewer_faces() -> None:
    mesh = trimesh.creation.icosphere(5, 0.5)
    far = np.array([1000.0, -2000.0, 500.0])  # nothing is lost far from the origin
    vertices, faces = decimate(np.asarray(mesh.vertices) + far, np.asarray(mesh.faces), 1000)
    assert 900 < len(faces) <= 1000 and len(np.unique(faces)) == len(vertices)
    np.testing.assert_allclose(np.linalg.norm(vertices - far, axis=1), 0.5, atol=0.007)
    made = trimesh.Trimesh(vertices - far, faces, process=False)
    assert made.is_watertight and made.volume == pytest.approx(mesh.volume, rel=0.01)
    same, _ = decimate(np.asarray(mesh.vertices), np.asarray(mesh.faces), 10**6)
    assert len(same) == len(mesh.vertices)
    with pytest.raises(OcnfError, match="not a number of faces"):
        decimate(vertices, faces, 3)


def test_cutting_near_measurements_only_leaves_out_nothing_that_was_seen(scan: Path) -> None:
    views = read_scan(scan, every=8).views
    pyramid, region, resolution = DepthPyramid(views), everything(views), 128
    octree = fuse_tsdf(pyramid, resolution, region.size, centre=region.centre)
    band = default_truncation(resolution, region.size)
    near = measured_trees(views, region, octree.shape, band)
    assert 0.02 < near.mean() < 0.7
    found = []
    for trees in (None, near):
        vertices, faces = octree_surface(octree, region.size, centre=region.centre, trees=trees)
        kept, triangles = keep_vertices(vertices, faces, observed(vertices, views, band))
        found.append({tuple(np.round(corners, 6).ravel()) for corners in kept[triangles]})
    assert len(found[0]) > 1000 and found[0] == found[1]
