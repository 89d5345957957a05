"""VolFus is the TSDF, out of what a data set stores."""

from __future__ import annotations

import numpy as np
import pytest

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import fuse, fuse_tsdf
from ocnf_data.views.cameras import Views
from ocnf_model.baselines import volfus_from_encoding


@pytest.fixture(scope="module")
def views() -> Views:
    """Two rough walls, one seen from each side."""
    depth = np.random.default_rng(0).normal(3, 0.05, (2, 60, 80)).astype(np.float32)
    depth[:, :20] = np.inf
    R = np.stack([np.eye(3), np.diag([-1.0, 1.0, -1.0])])
    K = np.array([[50.0, 0, 40], [0, 50, 30], [0, 0, 1]])
    return Views(depth, K, R, np.array([[0.0, 0, 3], [0, 0, 3]]))


@pytest.mark.parametrize("encoding", [Encoding.TSDF, Encoding.TDF_OCCUPANCY])
def test_comes_back_from_what_is_stored(views: Views, encoding: Encoding) -> None:
    found = volfus_from_encoding(fuse(views, encoding, 32), encoding)
    np.testing.assert_allclose(found.to_dense(), fuse_tsdf(views, 32).to_dense(), atol=4e-6)


@pytest.mark.parametrize("encoding", [Encoding.HISTOGRAM, Encoding.OCCUPANCY])
def test_other_encodings_do_not_have_it(views: Views, encoding: Encoding) -> None:
    with pytest.raises(OcnfError, match="Add tsdf"):
        volfus_from_encoding(fuse(views, encoding, 32), encoding)


def test_wrong_channels(views: Views) -> None:
    with pytest.raises(OcnfError, match="not in this encoding"):
        volfus_from_encoding(fuse(views, Encoding.HISTOGRAM, 32), Encoding.TSDF)
