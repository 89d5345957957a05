"""Real depth beside the sensor model: single frames against the fusion of all, by depth, angle and edge.

python tools/sensor_figure.py data/scans/box data/scans/kitchen --out docs/sensor.png

All frames of a sequence are fused finely; the surface is rendered into a part of the frames; what a frame
measured less what is rendered is the residual. The model (`ocnf_data.views.sensor`) is put on the same
rendered depth. A real residual holds more than the sensor's noise: errors of the poses, of the calibration
and of the fusion. The part that remains after the mean of 17 x 17 pixels is taken off holds little of those.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from ocnf_data.arrays import F32, F64, Bool
from ocnf_data.errors import OcnfError
from ocnf_data.fusion import DepthPyramid, fuse_tsdf
from ocnf_data.octree.surface import octree_surface
from ocnf_data.render import render_depth
from ocnf_data.views.cameras import Views
from ocnf_data.views.scans import read_scan
from ocnf_data.views.sensor import add_sensor_noise, pixel_angles, sensor_draws
from ocnf_model.scan.region import largest_object, observed

_SMOOTH = 17  # pixels
_SILHOUETTE = 0.08  # of the depth, within 7 pixels: not plain
_BORDER = 8
_WILD = 0.15  # metres: another surface, not noise
_ENOUGH = 2000  # pixels in a bin
_FACING = 40  # degrees
_DEPTHS = np.concatenate([np.arange(0.2, 1, 0.1), np.arange(1, 4.1, 0.25)])
_ANGLES = np.arange(0, 91, 10)
_REACH = 24  # pixels to either side of an edge


@dataclass(frozen=True)
class Sequence:
    """What was measured, what is there, and what the model makes of it: (V, H, W) metres, 0 for nothing."""

    name: str
    measured: F32
    truth: F32
    modelled: F32
    angles: F32
    plain: Bool


def load(folder: Path, resolution: int, n_frames: int, truncation: float) -> Sequence:
    """Fuse all frames, and render the surface into `n_frames` of them.

    Args:
        folder: of a scan.
        resolution: voxels along the cube around all that was measured.
        n_frames: evenly spread.
        truncation: of the fusion, as a multiple of a Kinect's step at the farthest depth.
    """
    scan = read_scan(folder)
    pyramid = DepthPyramid(scan.views)
    low, high = measured_bounds(scan.views)
    side = float((high - low).max()) * 1.1
    x, y, z = ((low + high) / 2).tolist()
    deepest = float(np.percentile(scan.views.depth[scan.views.depth > 0], 99))
    tau = max(truncation * deepest**2 / 351, 3 * side / resolution)
    octree = fuse_tsdf(pyramid, resolution, side, tau, centre=(x, y, z))
    vertices, faces = octree_surface(octree, side, centre=(x, y, z))
    faces = faces[observed(vertices, scan.views, tau / 2)[faces].all(axis=1)]
    chosen = np.linspace(0, len(scan.views) - 1, min(n_frames, len(scan.views))).astype(int)
    views = scan.views.subset(chosen)
    truth = render_depth(vertices, faces, views.K, views.R, views.T, views.size)
    truth[~np.isfinite(truth)] = 0
    modelled = np.stack([add_sensor_noise(depth, K, sensor_draws(0, folder.name, i, views.size))
                         for i, (depth, K) in enumerate(zip(truth, views.K, strict=True))])
    angles = np.stack([pixel_angles(smooth(depth), K) for depth, K in zip(truth, views.K, strict=True)])
    plain = np.stack([is_plain(depth) for depth in truth])
    return Sequence(folder.name, views.depth, truth, modelled, np.degrees(angles).astype(np.float32), plain)


def measured_bounds(views: Views) -> tuple[F64, F64]:
    """Corners of the box around all but a few of the measured points."""
    region = largest_object(views)
    return np.array(region.low), np.array(region.high)


def smooth(depth: F32) -> F32:
    """The mean of 5 x 5 pixels of the inverse depth, in which planes stay planes; 0 where one is missing."""
    known = depth > 0
    inverse = uniform_filter(np.divide(1, depth, out=np.zeros_like(depth), where=known), 5)
    out = np.divide(1, inverse, out=np.zeros_like(depth), where=inverse > 0)
    return np.where(minimum_filter(known, 5), out, 0).astype(np.float32)


def is_plain(depth: F32) -> Bool:
    """Where a surface fills the neighbourhood without a silhouette, away from the image's border."""
    near, far = minimum_filter(depth, 7), maximum_filter(depth, 7)
    plain = (near > 0) & (far - near < _SILHOUETTE * near)
    inner = np.zeros_like(plain)
    inner[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
    return np.asarray(plain & inner)


def deviation(values: F32) -> float:
    """Standard deviation by the median of absolute deviations, which a few wild values do not move."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) > _ENOUGH else np.nan


def fine(residual: F32, known: Bool) -> F32:
    """(V, H, W) residual less its mean over the known ones of 17 x 17 pixels."""
    means = [uniform_filter(np.where(k, r, 0), _SMOOTH)
             / np.maximum(uniform_filter(k.astype(np.float32), _SMOOTH), 1e-6)
             for r, k in zip(residual, known, strict=True)]
    return np.asarray(residual - np.stack(means), dtype=np.float32)


def by_bins(sequence: Sequence, depth: F32) -> dict[str, list[float]]:
    """Deviations of a measured or modelled depth by depth and by angle, and shares of pixels without one."""
    residual = depth - sequence.truth
    known = sequence.plain & (depth > 0) & (np.abs(residual) < _WILD)
    detail = fine(residual, known)
    facing = known & (sequence.angles < _FACING)
    found: dict[str, list[float]] = {name: [] for name in ("all", "fine", "all/z2", "fine/z2", "missing")}
    for low, high in pairwise(_DEPTHS):
        inside = facing & (sequence.truth >= low) & (sequence.truth < high)
        found["all"].append(1e3 * deviation(residual[inside]))
        found["fine"].append(1e3 * deviation(detail[inside]))
    for low, high in pairwise(_ANGLES):
        here = sequence.plain & (sequence.angles >= low) & (sequence.angles < high)
        inside = here & known
        square = sequence.truth[inside] ** 2
        found["all/z2"].append(1e3 * deviation(residual[inside] / square))
        found["fine/z2"].append(1e3 * deviation(detail[inside] / square))
        found["missing"].append(float((depth[here] == 0).mean()) if here.sum() > _ENOUGH else np.nan)
    return found


def beside_edges(sequence: Sequence, depth: F32) -> F64:
    """Share of pixels without a depth by the column's distance, -24 to 24, to an edge.

    The near part lies on the right. An edge is where the true depth falls by 0.25 m or more from one column
    to the next.
    """
    truth = sequence.truth[:, :, _REACH:-_REACH]
    after = sequence.truth[:, :, _REACH + 1 : -_REACH + 1 or None][:, :, : truth.shape[2]]
    view, row, column = np.nonzero((truth > 0) & (after > 0) & (truth - after > 0.25))
    window = depth[view[:, None], row[:, None], column[:, None] + np.arange(2 * _REACH + 1)]
    return np.asarray((window == 0).mean(axis=0)) if len(view) > 200 else np.full(2 * _REACH + 1, np.nan)


def print_table(sequence: Sequence, real: dict[str, list[float]], model: dict[str, list[float]]) -> None:
    """The figure's numbers."""
    print(f"\n{sequence.name}: {len(sequence.truth)} frames, {int((sequence.plain).sum()):,} plain pixels")
    print(f"{'depth m':>10} | real mm  fine | model mm  fine")
    for i, low in enumerate(_DEPTHS[:-1]):
        if not np.isnan(real["all"][i]):
            print(f"{low:4.2f}-{_DEPTHS[i + 1]:4.2f}  | {real['all'][i]:7.2f} {real['fine'][i]:5.2f} | "
                  f"{model['all'][i]:8.2f} {model['fine'][i]:5.2f}")
    print(f"{'angle':>10} | real mm/m^2 fine missing | model mm/m^2 fine missing")
    for i, low in enumerate(_ANGLES[:-1]):
        if not np.isnan(real["all/z2"][i]):
            print(f"{low:4d}-{_ANGLES[i + 1]:2d}    | " + " | ".join(
                f"{some['all/z2'][i]:8.2f} {some['fine/z2'][i]:6.2f} {100 * some['missing'][i]:6.1f} %"
                for some in (real, model)))


def draw(sequences: list[Sequence], path: Path) -> None:
    """One row of four panels a sequence, and the tables to the terminal."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(sequences), 4, figsize=(17, 4 * len(sequences)), layout="constrained",
                                squeeze=False)
    for row, sequence in zip(axes, sequences, strict=True):
        real, model = by_bins(sequence, sequence.measured), by_bins(sequence, sequence.modelled)
        print_table(sequence, real, model)
        depths, angles = ((bins[:-1] + bins[1:]) / 2 for bins in (_DEPTHS, _ANGLES))
        for panel, x, kinds, title in (
                (row[0], depths, ("all", "fine"), "deviation, mm, by depth, m"),
                (row[1], angles, ("all/z2", "fine/z2"), "deviation / z², mm/m², by angle"),
                (row[2], angles, ("missing",), "share not measured by angle")):
            _lines(panel, x, real, model, kinds)
            panel.set_title(f"{sequence.name}: {title}")
        edge = np.arange(-_REACH, _REACH + 1)
        row[3].plot(edge, beside_edges(sequence, sequence.measured), "C0", label="real")
        row[3].plot(edge, beside_edges(sequence, sequence.modelled), "C1", label="model")
        row[3].set_title(f"{sequence.name}: not measured, columns from an edge")
        for panel in row:
            panel.set_ylim(bottom=0)
            panel.grid(alpha=0.3)
            panel.legend()
    figure.savefig(path, dpi=80)
    print(f"\n{path}")


def _lines(panel: Any, x: F64, real: dict[str, list[float]], model: dict[str, list[float]],
           kinds: tuple[str, ...]) -> None:
    for kind, style in zip(kinds, ("-", "--"), strict=False):
        note = ", fine part" if style == "--" else ""
        panel.plot(x, real[kind], "C0" + style, label="real" + note)
        panel.plot(x, model[kind], "C1" + style, label="model" + note)


def main(
    scans: Annotated[list[Path], typer.Argument(help="Folders of posed depth.")],
    out: Annotated[Path, typer.Option(help="The picture.")] = Path("sensor.png"),
    resolution: Annotated[int, typer.Option(help="Voxels along the fused cube, a multiple of 8.")] = 384,
    frames: Annotated[int, typer.Option(min=1, help="To compare, evenly spread.")] = 25,
    truncation: Annotated[float, typer.Option(help="Of the fusion, in steps at the farthest depth.")] = 3.0,
) -> None:
    """Draw the statistics of real sequences and of the sensor model."""
    try:
        draw([load(folder, resolution, frames, truncation) for folder in scans], out)
    except OcnfError as error:
        typer.secho(str(error), fg="red", err=True)
        raise typer.Exit(1) from None


if __name__ == "__main__":
    typer.run(main)
