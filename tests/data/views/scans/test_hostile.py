"""Random bytes give our error and nothing else."""

from __future__ import annotations

import io
import json
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.files.strict_yaml import read_yaml
from ocnf_data.views.scans import read_scan
from ocnf_data.views.scans.images import image_size, read_colour, read_depth

DEPTH = np.arange(48, dtype=np.uint16).reshape(6, 8)


def _whole(suffix: str) -> bytes:
    if suffix == ".npy":
        stream = io.BytesIO()
        np.save(stream, DEPTH)
        return stream.getvalue()
    if suffix == ".pgm":
        return b"P5 8 6 65535\n" + DEPTH.astype(">u2").tobytes()
    image = DEPTH if suffix == ".png" else np.full((6, 8, 3), 99, np.uint8)
    return cv2.imencode(suffix, image)[1].tobytes()


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(suffix=st.sampled_from([".png", ".pgm", ".npy", ".jpg"]), data=st.data())
def test_damaged_images(tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    whole = bytearray(_whole(suffix))
    for _ in range(data.draw(st.integers(0, 3))):
        whole[data.draw(st.integers(0, min(len(whole) - 1, 160)))] = data.draw(st.integers(0, 255))
    file = tmp_path / f"image{suffix}"
    kept = data.draw(st.integers(0, len(whole)))
    file.write_bytes(bytes(whole[:kept]) + data.draw(st.binary(max_size=20)))
    for read in (image_size, read_depth, read_colour):
        with suppress(OcnfError):
            read(file)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(value=st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
                          lambda inner: st.lists(inner, max_size=4)),
       field=st.sampled_from(["frames", "w", "fl_x", "cx", "camera_model", "transform_matrix", "k1",
                              "applied_scale", "depth_file_path", "file_path", "camera_angle_x"]))
def test_any_value_in_any_field_of_transforms(write, value: object, field: str, tmp_path: Path) -> None:
    folder = tmp_path / "transforms"
    if not folder.exists():
        write("transforms")
        (folder / "whole.json").write_text((folder / "transforms.json").read_text())
    data = json.loads((folder / "whole.json").read_text())
    (data if field in data or field in ("applied_scale", "camera_angle_x", "k1") else data["frames"][1])[
        field] = value
    (folder / "transforms.json").write_text(json.dumps(data))
    with suppress(OcnfError):
        read_scan(folder)


@pytest.mark.parametrize("tag", ["!!python/object/apply:os.getcwd []", "!!python/name:os.system",
                                 "!!python/module:os", "!!python/object:os.PathLike {}",
                                 "!!python/bytes aa=="])
def test_yaml_builds_tuples_and_nothing_else(tmp_path: Path, tag: str) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("a: !!python/tuple [1, [2, 3]]\n")
    assert read_yaml(file, tuples=True) == {"a": (1, [2, 3])}
    with pytest.raises(OcnfError, match="not valid YAML"):
        read_yaml(file)
    for text in (f"a: {tag}\n", f"a: !!python/tuple [{tag}]\n"):
        file.write_text(text)
        with pytest.raises(OcnfError, match="not valid YAML"):
            read_yaml(file, tuples=True)
