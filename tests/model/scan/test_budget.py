"""Voxels that do not fit into memory are refused at once, with a size that does."""

from __future__ import annotations

import re

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.views.cameras import Views
from ocnf_model.scan import budget
from ocnf_model.scan.budget import check_memory
from ocnf_model.scan.region import Region


@pytest.fixture
def views() -> Views:
    """A wall one metre before a camera."""
    return Views(np.ones((1, 48, 64), np.float32), np.array([[55.0, 0, 31.2], [0, 56.0, 23.4], [0, 0, 1]]),
                 np.eye(3)[None], np.zeros((1, 3)))


def remember(monkeypatch: pytest.MonkeyPatch, gigabytes: float) -> None:
    """A machine of so much memory."""
    monkeypatch.setattr(budget, "usable_memory", lambda: int(gigabytes * 1e9))


@pytest.mark.parametrize("length", [0.78, 0.404, 0.7547, 0.43, 0.4, 0.7999, 8.0])
def test_the_largest_voxel_that_is_named_is_taken(views: Views, length: float) -> None:
    region = Region.of_cube((0.0, 0.0, 1.0), length)
    with pytest.raises(OcnfError, match="too large for the region") as refused:
        check_memory(views, region, length, 64)
    check_memory(views, region, float(re.search(r"at most (\S+) m", str(refused.value))[1]), 64)


@pytest.mark.parametrize("gigabytes", np.linspace(0.5, 64, 21))
def test_what_is_named_in_place_of_too_small_voxels_fits(views: Views, monkeypatch: pytest.MonkeyPatch,
                                                         gigabytes: float) -> None:
    remember(monkeypatch, gigabytes)
    region = Region.of_box((-0.4, -0.3, 0.7, 0.4, 0.3, 1.3))
    with pytest.raises(OcnfError, match="voxel: the surface would not fit into memory") as refused:
        check_memory(views, region, 1e-5, 256)
    check_memory(views, region, float(re.search(r"--voxel (\S+) or more", str(refused.value))[1]), 256)
    with pytest.raises(OcnfError, match="resolution: the surface would not fit into memory") as refused:
        check_memory(views, region, None, 80_000)
    assert "--voxel" not in str(refused.value)
    check_memory(views, region, None, int(re.search(r"--resolution (\d+) or less", str(refused.value))[1]))


def test_what_is_needed_reads_as_more_than_there_is(views: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    region = Region.of_box((-0.4, -0.3, 0.7, 0.4, 0.3, 1.3))
    remember(monkeypatch, budget.estimate_bytes(views, region, 0.001) / 0.7 / 1e9 * 0.999)
    with pytest.raises(OcnfError) as refused:
        check_memory(views, region, 0.001, 256)
    said = re.search(r"about (\S+) GB, expected at most (\S+) GB", str(refused.value))
    assert float(said[1]) > float(said[2])


@pytest.mark.parametrize("voxel", [1e-9, 1e-300, 5e-324])
def test_measured_points_are_gone_through_once(views: Views, monkeypatch: pytest.MonkeyPatch,
                                               voxel: float) -> None:
    calls = []
    measured = budget.measured_points
    monkeypatch.setattr(budget, "measured_points", lambda views: calls.append(1) or measured(views))
    with pytest.raises(OcnfError, match="would not fit into memory"):
        check_memory(views, Region.of_box((-0.4, -0.3, 0.7, 0.4, 0.3, 1.3)), voxel, 256)
    assert len(calls) == 1


def test_a_cube_of_too_few_voxels_names_the_resolution(views: Views) -> None:
    with pytest.raises(OcnfError, match=r"resolution: the voxels are too large.*8, expected 16 or more"):
        check_memory(views, Region.of_box((-0.4, -0.3, 0.7, 0.4, 0.3, 1.3)), None, 8)


@pytest.mark.parametrize("voxel", ["0.01", 0.0, -1.0, np.nan])
def test_what_is_no_size_of_a_voxel_is_refused(views: Views, voxel: object) -> None:
    with pytest.raises(OcnfError, match="voxel: not the size of a voxel"):
        check_memory(views, Region.of_box((-0.4, -0.3, 0.7, 0.4, 0.3, 1.3)), voxel, 256)
