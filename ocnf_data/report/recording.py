"""The samples of a page as a recording for the rerun viewer (rerun.io), one after the other on a timeline."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from ocnf_data.arrays import U8
from ocnf_data.errors import OcnfError, missing_extra
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.report.blob import unpack
from ocnf_data.report.contents import ERROR_COLOURS, Card, Scale
from ocnf_data.report.geometry import STEPS


class Recording:
    """Writes what `Card`s show, sample by sample.

    Args:
        path: the recording, FILE.rrd; one that is there is replaced.
        scale: of the cards.
        up: the axis that points up, y or z.

    Raises:
        OcnfError: `missing_extra` without rerun-sdk; the file cannot be written.
    """

    def __init__(self, path: Path, scale: Scale, up: str) -> None:
        if path.suffix.lower() != ".rrd":
            raise OcnfError("not the name of a recording", where=path, found=path.suffix or "no suffix",
                            expected=".rrd", fix=f"call it {path.name}.rrd")
        self._rerun, self._scale = _library(), scale
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("wb").close()
            self._stream = self._rerun.RecordingStream("ocnf")
            self._stream.save(path)
        axes = self._rerun.ViewCoordinates
        self._stream.log("sample", axes.RIGHT_HAND_Z_UP if up == "z" else axes.RIGHT_HAND_Y_UP, static=True)
        self._n = 0

    def add(self, card: Card) -> None:
        """Add a sample: surfaces and points in metres with their errors as colours, depth maps."""
        rerun, (arrays, meta) = self._rerun, unpack(card.blob)
        self._stream.set_time("sample", sequence=self._n)
        self._n += 1
        text = f"{card.key}\n{card.category}, {card.split}\n{card.source}"
        self._stream.log("key", rerun.TextDocument(text))
        for number, shown in enumerate(meta["shown"]):
            at = f"surface{number}"
            points = ((arrays[f"{at}/positions"] / STEPS - 0.5) * self._scale.extent).astype(np.float32)
            colours = _colours(arrays.get(f"{at}/error"))
            place = f"sample/{shown['name'].lower().replace(' ', '_')}"
            if shown["kind"] == "points":
                self._stream.log(place, rerun.Points3D(points, colors=colours, radii=self._scale.voxel / 4))
            else:
                self._stream.log(place, rerun.Mesh3D(
                    vertex_positions=points, triangle_indices=arrays[f"{at}/faces"], vertex_colors=colours,
                    vertex_normals=_normals(points, arrays[f"{at}/faces"])))
        for number in range(len(meta["depths"])):
            self._stream.log(f"depth/{number}", rerun.Image(_picture(arrays[f"depth{number}"])))

    def finish(self) -> None:
        """Write what is left; afterwards nothing can be added."""
        self._stream.disconnect()


def _library() -> ModuleType:
    try:
        import rerun
    except ImportError as error:
        raise missing_extra("a recording needs rerun-sdk", "rerun") from error
    return rerun


def _colours(error: npt.NDArray[Any] | None) -> U8 | None:
    """The page's colours (N, 3) of errors (N,) in its steps; None: plain."""
    if error is None:
        return None
    stops = np.array([[int(stop[at : at + 2], 16) for at in (1, 3, 5)] for stop in ERROR_COLOURS])
    place = np.linspace(0, 255, len(stops))
    return np.stack([np.interp(error, place, channel) for channel in stops.T], axis=1).astype(np.uint8)


def _normals(points: npt.NDArray[np.float32], faces: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Unit normals (N, 3) at the vertices: the mean over their triangles, weighted by area."""
    corners = points[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(points)
    for corner in faces.T:
        np.add.at(total, corner, across)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.divide(total, length, out=total, where=length > 0)


def _picture(data: U8) -> U8:
    import cv2

    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    if picture is None:
        raise RuntimeError("OpenCV did not decode a picture of its own")
    return np.ascontiguousarray(picture[..., ::-1], np.uint8)
