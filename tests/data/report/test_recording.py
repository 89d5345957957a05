"""`--rerun`: what goes into the recording, with a stand-in for the library and, where it is, with itself."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.report.run import write_report

EXTENT = 3.0


class Stream:
    """Notes what is logged, and at which number of the timeline."""

    def __init__(self, name: str) -> None:
        self.name, self.path, self.now, self.is_open = name, None, None, True
        self.logged: dict[tuple[int | None, str], Any] = {}

    def save(self, path: Path) -> None:
        self.path = path

    def set_time(self, timeline: str, *, sequence: int) -> None:
        assert timeline == "sample"
        self.now = sequence

    def log(self, place: str, what: Any, *, static: bool = False) -> None:
        assert self.is_open
        self.logged[None if static else self.now, place] = what

    def disconnect(self) -> None:
        self.is_open = False


@pytest.fixture
def streams(monkeypatch: pytest.MonkeyPatch) -> list[Stream]:
    """A stand-in for rerun-sdk, and the streams that were made with it."""
    made: list[Stream] = []
    library = ModuleType("rerun")

    def stream(name: str) -> Stream:
        made.append(Stream(name))
        return made[-1]

    library.RecordingStream = stream
    library.ViewCoordinates = SimpleNamespace(RIGHT_HAND_Z_UP="z is up", RIGHT_HAND_Y_UP="y is up")
    library.TextDocument = library.Image = lambda what: what
    library.Points3D = lambda points, **more: {"points": points, **more}
    library.Mesh3D = lambda **parts: parts
    monkeypatch.setitem(sys.modules, "rerun", library)
    return made


def test_every_surface_and_picture_is_recorded(report_made: Any, tmp_path: Path, streams: list[Stream],
                                               read_page: Callable) -> None:
    done = write_report(str(report_made.data), tmp_path / "page.html", meshes=report_made.meshes, up="y",
                        rerun=tmp_path / "a.rrd")
    assert done.paths == [tmp_path / "page.html", tmp_path / "a.rrd"]
    [stream] = streams
    assert not stream.is_open and stream.path == tmp_path / "a.rrd"
    assert stream.logged[None, "sample"] == "y is up"
    page, sample = read_page(tmp_path / "page.html")
    for number, row in enumerate(page["samples"]):
        arrays, meta = sample(number)
        assert stream.logged[number, "key"].startswith(row["key"])
        for at, name in enumerate(("mesh", "noisy_input", "volfus", "ground_truth")):
            logged = stream.logged[number, f"sample/{name}"]
            points = (arrays[f"surface{at}/positions"] / 65535 - 0.5) * EXTENT
            found = logged["points" if name == "noisy_input" else "vertex_positions"]
            np.testing.assert_allclose(found, points, atol=1e-6)
            if name != "noisy_input":
                np.testing.assert_array_equal(logged["triangle_indices"], arrays[f"surface{at}/faces"])
                length = np.linalg.norm(logged["vertex_normals"], axis=1)
                assert (np.isclose(length, 1, atol=1e-5) | (length == 0)).all() and length.mean() > 0.9
            colours = logged["colors" if name == "noisy_input" else "vertex_colors"]
            assert (colours is None) == (not meta["shown"][at]["hasError"])
            if colours is not None:
                error = arrays[f"surface{at}/error"]
                assert colours.shape == (len(points), 3)
                assert (colours[error == 255] == [0x5D, 0x12, 0x30]).all()
                assert (colours[error == 0] == [0xEC, 0xE9, 0xE2]).all()
        assert [stream.logged[number, f"depth/{view}"].shape for view in range(4)] == [(60, 80, 3)] * 4


def test_what_is_wrong_is_said_before_anything_is_drawn(report_made: Any, tmp_path: Path,
                                                        monkeypatch: pytest.MonkeyPatch,
                                                        streams: list[Stream]) -> None:
    def refused(rerun: Path) -> OcnfError:
        with pytest.raises(OcnfError) as error:
            write_report(str(report_made.data), tmp_path / "page.html", rerun=rerun, progress=pytest.fail)
        return error.value

    assert "not the name of a recording" in str(refused(tmp_path / "a.txt"))
    (tmp_path / "file").touch()
    assert "file" in str(refused(tmp_path / "file" / "a.rrd"))
    monkeypatch.setitem(sys.modules, "rerun", None)
    error = refused(tmp_path / "a.rrd")
    assert error.code == "missing_extra" and str(error).splitlines()[-1] == "pip install 'ocnf[rerun]'"
    assert not (tmp_path / "a.rrd").exists()


def test_the_library_itself_writes_a_recording(report_made: Any, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: its recording is tested by a stand-in")
    write_report(str(report_made.data), tmp_path / "page.html", meshes=report_made.meshes, limit=1,
                 rerun=tmp_path / "a.rrd")
    assert (tmp_path / "a.rrd").read_bytes().startswith(b"RRF")
    assert (tmp_path / "a.rrd").stat().st_size > 20_000
