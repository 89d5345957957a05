"""`.oc` files: golden bytes, the way there and back, and files that lie."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree

QUIET = {"deadline": None, "suppress_health_check": [HealthCheck.function_scoped_fixture]}


def golden_bytes(data: np.ndarray) -> bytes:
    """The golden octree's file, put together by hand from the format's description."""
    return b"".join([
        struct.pack("<7i", 31193, 1, 1, 1, 2, 1, 37),
        struct.pack("<4I", 0, 0, 0, 0),
        struct.pack("<4I", 1 | 1 << 6 | 1 << 8, 1 << 52 - 32, 1 << 72 - 64, 0),
        struct.pack("<37f", *data.ravel()),
        struct.pack("<2i", 0, 1),
    ])


def test_golden_file(golden: tuple[np.ndarray, GridOctree], tmp_path: Path) -> None:
    volume, octree = golden
    octree.write_oc(tmp_path / "golden.oc")
    assert (tmp_path / "golden.oc").read_bytes() == golden_bytes(octree.data)
    np.testing.assert_array_equal(GridOctree.read_oc(tmp_path / "golden.oc").to_dense(), volume)


@settings(**QUIET)
@given(st.data())
def test_there_and_back(octrees: Callable, tmp_path: Path, data: st.DataObject) -> None:
    octree = data.draw(octrees())
    octree.write_oc(tmp_path / "a.oc")
    again = GridOctree.read_oc(tmp_path / "a.oc")
    assert np.array_equal(again.trees, octree.trees)
    np.testing.assert_array_equal(again.data, octree.data)


def test_unused_bits_are_masked(golden: tuple[np.ndarray, GridOctree], tmp_path: Path) -> None:
    volume, octree = golden
    raw = bytearray(golden_bytes(octree.data))
    raw[28 + 16 + 9] |= 0xFE  # bits 73-79 of the second tree
    raw[28 + 16 + 15] = 0xFF
    (tmp_path / "a.oc").write_bytes(raw)
    np.testing.assert_array_equal(GridOctree.read_oc(tmp_path / "a.oc").to_dense(), volume)


HEADER = ("magic", "n", "grid_depth", "grid_height", "grid_width", "channels", "n_leafs")


@pytest.mark.parametrize(
    ("offset", "value", "words"),
    [
        (0, 31194, r"magic: not a \.oc file; found 31194, expected 31193"),
        (4, 2, "n: holds a batch.* found 2, expected 1"),
        *[(4 * i, bad, f"{HEADER[i]}: not a size; found {bad}") for i in range(2, 7) for bad in (0, -1)],
        *[(4 * i, 2**31 - 1, "does not fit the size of the file") for i in range(2, 7)],
        (28 + 16, 0, "no tree"),  # the second tree's root is no longer split
        (28, 1, r"44 leaves"),  # the first tree's is
        (28 + 32, 0x7FC00000, "not finite"),
        (28 + 32 + 4 * 37 + 4, 2, r"prefix_leafs\[1\]: is not the sum.* found 2, expected 1"),
    ],
)
def test_contradictions(
    golden: tuple[np.ndarray, GridOctree], tmp_path: Path, offset: int, value: int, words: str
) -> None:
    raw = bytearray(golden_bytes(golden[1].data))
    raw[offset : offset + 4] = struct.pack("<i", value)
    path = tmp_path / "a.oc"
    path.write_bytes(raw)
    with pytest.raises(OcnfError, match=words) as caught:
        GridOctree.read_oc(path)
    assert caught.value.where == str(path)


def test_every_truncation_and_any_extra_byte(golden: tuple[np.ndarray, GridOctree], tmp_path: Path) -> None:
    raw = golden_bytes(golden[1].data)
    for damaged in (*(raw[:n] for n in range(len(raw))), raw + b"\0"):
        (tmp_path / "a.oc").write_bytes(damaged)
        with pytest.raises(OcnfError, match=r"too short|size of the file"):
            GridOctree.read_oc(tmp_path / "a.oc")


@settings(**QUIET)
@given(st.data())
def test_damage_is_an_error_or_another_valid_octree(
    golden: tuple[np.ndarray, GridOctree], tmp_path: Path, data: st.DataObject
) -> None:
    raw = bytearray(golden_bytes(golden[1].data))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
    (tmp_path / "a.oc").write_bytes(raw)
    try:
        octree = GridOctree.read_oc(tmp_path / "a.oc")
    except OcnfError:
        return
    GridOctree(octree.trees, octree.data)


def test_files_that_cannot_be_opened(golden: tuple[np.ndarray, GridOctree], tmp_path: Path) -> None:
    with pytest.raises(OcnfError, match="cannot be read: No such file"):
        GridOctree.read_oc(tmp_path / "none.oc")
    with pytest.raises(OcnfError, match="cannot be read: Is a directory"):
        GridOctree.read_oc(tmp_path)
    with pytest.raises(OcnfError, match="cannot be written: No such file"):
        golden[1].write_oc(tmp_path / "none" / "a.oc")
