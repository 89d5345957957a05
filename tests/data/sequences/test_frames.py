"""Frames of a scan are listed with numbers that can be used, or the scan is refused with a sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ocnf_data import generate
from ocnf_data.errors import OcnfError
from ocnf_data.manifest import Manifest
from ocnf_data.sequences.frames import FrameSequence
from ocnf_data.views.scans.listing import Axes, Said

from .conftest import sequence_manifest


@pytest.fixture
def captured(tmp_path: Path) -> Any:
    """Write a capture of three frames with a `transforms.json`; arguments replace its fields."""

    def write(**fields: Any) -> Path:
        folder = tmp_path / "scans" / "long"
        folder.mkdir(parents=True, exist_ok=True)
        frames = []
        for i in range(3):
            cv2.imwrite(str(folder / f"{i}.png"), np.full((12, 16), 1000, np.uint16))
            frames.append({"depth_file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist()})
        camera = {"fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12}
        (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames, **fields}))
        return folder

    return write


@pytest.mark.parametrize(("field", "value"), [("cx", float("nan")), ("fl_x", float("inf")), ("fl_y", -3.0)])
def test_intrinsics_that_are_none_are_refused_when_the_scan_is_listed(captured, tmp_path, field,
                                                                      value) -> None:
    folder = captured(**{field: value})
    with pytest.raises(OcnfError, match=r"transforms\.json: 0\.png: not a pinhole's intrinsics"):
        FrameSequence.open(folder)
    manifest = sequence_manifest({"inputs": [{"name": "v2", "views": 2, "encodings": ["tsdf"]}]},
                                 configurations={"train": 1}, reading={})
    with pytest.raises(OcnfError, match="not a pinhole's intrinsics"):
        generate(manifest, tmp_path / "set", folder.parent, progress=False)


def test_axes_of_the_users_count_where_they_are_not_the_formats(captured, tmp_path: Path) -> None:
    folder = captured()
    usual, same, other = (FrameSequence.open(folder, said=Said(axes=axes))
                          for axes in (None, Axes.OPENGL, Axes.OPENCV))
    assert usual.checksum() == same.checksum() != other.checksum()
    assert np.allclose(usual.read().views.R, np.diag([1, -1, -1]))
    assert np.allclose(other.read().views.R, np.eye(3))
    plain, said = (sequence_manifest(configurations={"train": 1}, reading=reading)
                   for reading in ({}, {"axes": "opencv"}))
    assert "axes" not in plain.to_dict()["source"]["reading"]  # what data sets begun before say
    assert said.to_dict()["source"]["reading"]["axes"] == "opencv"
    again = Manifest.from_dict(said.to_dict())
    assert again == said != plain and again.source.reading.said.axes is Axes.OPENCV


def test_intrinsics_of_the_users_stand_in_for_them(captured) -> None:
    said = Said(intrinsics=(20.0, 20.0, 7.5, 5.5))
    whole = FrameSequence.open(captured(), said=said)
    assert np.array_equal(whole.read().views.K[0], whole.listing.frames[0].K)
    spoilt = FrameSequence.open(captured(cx=float("nan")), said=said)
    assert len(spoilt.checksum()) == 64
    assert np.array_equal(spoilt.read().views.K, whole.read().views.K)
