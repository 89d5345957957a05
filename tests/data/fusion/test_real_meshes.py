"""Fusion of real meshes: octrees of the size that exact constants give."""

import os
from pathlib import Path

import numpy as np
import pytest

from ocnf_data.fusion import DepthPyramid, default_truncation, fuse_tsdf
from ocnf_data.meshes import normalise, read_mesh
from ocnf_data.render import render_depth
from ocnf_data.views.cameras import Views
from ocnf_data.views.rigs import intrinsics, look_from, published80, view_subset

DATA = os.environ.get("OCNF_DATA")
pytestmark = pytest.mark.skipif(DATA is None, reason="OCNF_DATA, the folder of real meshes, is not set")


@pytest.fixture(scope="module")
def chair() -> DepthPyramid:
    """80 views of a real chair."""
    mesh = read_mesh(sorted(Path(DATA, "meshes", "chair", "test").glob("*.obj"))[2])
    vertices, _ = normalise(mesh)
    K, (R, T) = intrinsics(351, 351, 320, 240), look_from(published80(), 3.0)
    return DepthPyramid(Views(render_depth(vertices, mesh.faces, K, R, T, size=(480, 640)), K, R, T))


def test_leaves_of_a_chair(chair):
    shares = [fuse_tsdf(chair, resolution).n_leaves / resolution**3 for resolution in (64, 128, 256)]
    np.testing.assert_allclose(shares, [0.095, 0.045, 0.023], rtol=0.1)


def test_a_chair_equals_the_oracle(chair, oracle):
    views = chair.views
    few = views.subset(view_subset(len(views), 8))
    for resolution in (64, 104):
        dense = oracle(few, (resolution,) * 3)
        fused = fuse_tsdf(few, resolution).to_dense()
        wrong = np.abs(fused - dense.values["tsdf"]).max(axis=0) > 3e-6
        assert not (wrong & ~dense.tie).any()
        assert dense.tie.mean() < 1e-4


def test_finer_grids_lie_closer_to_the_same_surface(chair):
    """A coarse TSDF in metres is close to the mean of the finer one's voxels where neither is truncated."""
    coarse, fine = (fuse_tsdf(chair, n).to_dense()[0] for n in (64, 128))
    pooled = fine.reshape(64, 2, 64, 2, 64, 2).mean(axis=(1, 3, 5)) * default_truncation(128)
    metres = coarse * default_truncation(64)
    both = (np.abs(metres) < 0.03) & (np.abs(pooled) < 0.03)
    assert both.sum() > 1000
    assert np.abs(metres - pooled)[both].mean() < 0.015
