"""Is a data set physically right? Compares stored octrees with the meshes; shares no code with fusion.

For some samples the mesh is read and rendered again, or the frames of the scan, and then
- *cells*: at random voxels of every octree, the value is that of a plain float64 evaluation of all views
  (half of the voxels lie in width-1 leaves, where the surface is), within the rounding that storage allows,
  and the sign is the same; voxels whose projection is a rounding tie are left out;
- *range*: values lie in [-1, 1], and histograms sum to 1;
- *surface*: the ground truth's zero crossings lie on the mesh, measured against the points that the clean
  depth maps see, and the mesh's seen points lie on zero crossings. Of a scan the crossings between voxels
  that some frame counts lie on what the frames measured; what single frames mistook lies where it may.
`ocnf-data verify` checks bytes; this checks meaning.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ocnf_data.arrays import F64, I64, Bool
from ocnf_data.encodings import Encoding
from ocnf_data.generation.remake import remake
from ocnf_data.manifest import Manifest
from ocnf_data.manifest.sequence import SequenceSource
from ocnf_data.octree import GridOctree
from ocnf_data.octree.surface import octree_surface
from ocnf_data.render.pictures import signed
from ocnf_data.sequences.known import known_surface
from ocnf_data.shards.browse import StoredSample, stored_samples
from ocnf_data.shards.dataset import load_dataset
from ocnf_data.shards.tarformat import input_member, target_member
from ocnf_data.views.cameras import Views

TARGET_ERROR, INPUT_ERROR = 5e-4, 1 / 255  # what storing may change, in units of tau
ROUNDING = 1e-6  # of float32 against float64
TIE = 1e-6  # pixels
NEAR_SURFACE = 0.75  # voxels, median of the distances
_HELD = 0.05  # share of the seen points that has to be thicker to be judged: fewer are ends and joints
_CELLS = 8  # along a voxel: what frames have measured is told apart by as much
ON_SURFACE = 0.9  # share of seen mesh points within 1.5 voxels of a zero crossing
THIN = 2.0  # voxels: about as far as a TSDF reaches, so that both sides of something thinner cancel


@dataclass(frozen=True)
class Finding:
    """One line of the table."""

    key: str
    member: str
    check: str
    found: str
    ok: bool


def distances(views: Views, points: F64) -> tuple[F64, Bool]:
    """(V, N) `depth - z` along the camera's axis, NaN where a view says nothing; (N,) rounding ties."""
    height, width = views.size
    out = np.full((len(views), len(points)), np.nan)
    tie = np.zeros(len(points), dtype=bool)
    for i in range(len(views)):
        x, y, z = (points @ views.R[i].T + views.T[i]).T
        front = z > 0
        safe = np.where(front, z, 1.0)
        u = views.K[i, 0, 0] * x / safe + views.K[i, 0, 2] + 0.5
        v = views.K[i, 1, 1] * y / safe + views.K[i, 1, 2] + 0.5
        tie |= front & ((np.abs(u - np.round(u)) < TIE) | (np.abs(v - np.round(v)) < TIE))
        inside = front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        row, column = np.floor(v[inside]).astype(int), np.floor(u[inside]).astype(int)
        depth = views.depth[i][row, column].astype(np.float64)
        out[i, inside] = np.where(depth > 0, depth - z[inside], np.nan)
    return out, tie


def values_of(distance: F64, encoding: Encoding, tau: float, voxel: float) -> F64:
    """(N, C) values of an encoding, in units of tau, from (V, N) distances."""
    if encoding is Encoding.OCCUPANCY:
        return np.where((np.nan_to_num(distance, nan=-1.0) > voxel).any(axis=0), 0.0, 1.0)[:, None]
    valid = np.nan_to_num(distance, nan=-np.inf) >= -tau
    count = valid.sum(axis=0)
    clipped = np.where(valid, np.minimum(np.nan_to_num(distance, posinf=tau) / tau, 1), 0)
    tsdf = np.where(count > 0, clipped.sum(axis=0) / np.maximum(count, 1), -1.0)
    if encoding is Encoding.TSDF:
        return tsdf[:, None]
    if encoding is Encoding.TDF_OCCUPANCY:
        return np.stack([np.abs(tsdf), (tsdf < 0).astype(float)], axis=1)
    centres = np.linspace(-1.125, 1.125, encoding.channels)
    place = np.nan_to_num(distance, nan=0.0, posinf=np.inf) / tau
    place = np.clip(place, centres[0], centres[-1])
    share = np.maximum(0, 1 - np.abs(place[..., None] - centres) / (centres[1] - centres[0]))
    votes = (share * valid[..., None]).sum(axis=0) / np.maximum(count, 1)[:, None]
    votes[count == 0, 0] = 1
    return votes


def choose_cells(octree: GridOctree, n: int, rng: np.random.Generator) -> I64:
    """(n, 3) voxels (z, y, x): half anywhere, half in width-1 leaves."""
    anywhere = rng.integers(0, octree.shape, size=(n - n // 2, 3))
    fine = octree.leaf_positions()[octree.leaf_sizes() == 1]
    return np.concatenate([anywhere, fine[rng.integers(0, len(fine), n // 2)]]) if len(fine) else anywhere


def check_cells(octree: GridOctree, views: Views, encoding: Encoding, tau: float, extent: float, bound: float,
                n: int, rng: np.random.Generator) -> tuple[str, bool]:
    """Compare `n` voxels with their plain evaluation."""
    voxel = extent / octree.shape[0]
    cells = choose_cells(octree, n, rng)
    points = ((cells[:, ::-1] + 0.5) * voxel - extent / 2).astype(np.float64)
    distance, tie = distances(views, points)
    truth = values_of(distance, encoding, tau, voxel)[~tie]
    stored = octree.gather(cells)[~tie].astype(np.float64)
    error = np.abs(stored - truth)
    # Where a rule steps, float32 and float64 may fall on either side.
    known = np.nan_to_num(distance[:, ~tie], nan=np.inf, posinf=np.inf)
    steps = ((np.abs(known + tau) < ROUNDING) | (np.abs(known - voxel) < ROUNDING)).any(axis=0)
    wrong = (error.max(axis=1) > bound + ROUNDING) & ~steps
    if encoding is Encoding.TSDF:
        wrong |= ((stored < 0) != (truth < 0))[:, 0] & (np.abs(truth[:, 0]) > ROUNDING) & ~steps
    largest = error[~steps].max(initial=0)
    return f"{wrong.sum()} of {len(truth):,} differ, largest error {largest:.1e}", not wrong.any()


def check_range(octree: GridOctree, encoding: Encoding) -> tuple[str, bool]:
    """Values in [-1, 1]; histograms and occupancies in [0, 1]; histograms sum to 1."""
    low, high = float(octree.data.min()), float(octree.data.max())
    ok = low >= (-1 if encoding is Encoding.TSDF else 0) and high <= 1
    text = f"[{low:.4g}, {high:.4g}]"
    if encoding is Encoding.HISTOGRAM:
        off = float(np.abs(octree.data.sum(axis=1, dtype=np.float64) - 1).max())
        ok &= off < 1e-5
        text += f", sums within {off:.0e} of 1"
    return text, ok


def check_surface(octree: GridOctree, views: Views, encoding: Encoding, extent: float) -> tuple[str, bool]:
    """Distances between the zero crossings and the points that the clean views see, in voxels.

    What is thinner than the grid can hold, so that some view sees free space `THIN` voxels behind a point,
    may have no crossing: it is not asked for.
    """
    from scipy.spatial import cKDTree

    voxel = extent / octree.shape[0]
    vertices, _ = octree_surface(signed(octree, encoding), extent)
    if len(vertices) == 0:
        return "no zero crossing", False
    by_view = list(_seen_points(views))
    seen = np.concatenate(by_view)
    view = np.repeat(np.arange(len(views)), [len(points) for points in by_view])
    median = float(np.median(cKDTree(seen).query(vertices, workers=-1)[0])) / voxel
    some = np.random.default_rng(0).integers(0, len(seen), 20_000)
    points, rays = seen[some], seen[some] - views.centres[view[some]]
    behind = points + THIN * voxel * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    held = points[~(distances(views, behind)[0] > 0).any(axis=0)]
    text = f"median {median:.2f} voxels off the mesh"
    if len(held) < _HELD * len(points):
        return f"{text}; nearly all of it is thin", median < NEAR_SURFACE
    share = float((cKDTree(vertices).query(held, workers=-1)[0] < 1.5 * voxel).mean())
    text += f"; {share:.1%} of its seen points within 1.5 of a crossing"
    if len(held) < len(points):
        text += f", {1 - len(held) / len(points):.1%} of them left out as thin"
    return text, median < NEAR_SURFACE and share > ON_SURFACE


def check_measured_surface(octree: GridOctree, views: Views, encoding: Encoding,
                           extent: float) -> tuple[str, bool]:
    """Distances of a scan's crossings that were measured to what its frames have measured, in voxels."""
    from scipy.spatial import cKDTree

    voxel = extent / octree.shape[0]
    cut = (known_surface(octree, extent) if encoding is Encoding.TSDF else
           octree_surface(signed(octree, encoding), extent))
    if len(cut[0]) == 0:
        return "no zero crossing", False
    measured = _places(views, octree.shape[0] * _CELLS, extent)
    if len(measured) == 0:
        return "no measurement in the cube", False
    median = float(np.median(cKDTree(measured).query(cut[0], workers=-1)[0])) / voxel
    return f"median {median:.2f} voxels off what the frames measured", median < NEAR_SURFACE


def _places(views: Views, n: int, extent: float) -> F64:
    """The centres of those of n x n x n cells of the cube that something was measured in: millions of pixels
    see few places.
    """
    keys = []
    for points in _seen_points(views):
        cells = np.floor((points / extent + 0.5) * n).astype(np.int64)
        cells = cells[((cells >= 0) & (cells < n)).all(axis=1)]
        keys.append(np.unique(cells @ np.array([n * n, n, 1])))
    key = np.unique(np.concatenate(keys))
    return (np.stack([key // (n * n), key // n % n, key % n], axis=1) + 0.5) * (extent / n) - extent / 2


def _seen_points(views: Views) -> Iterator[F64]:
    """World points of the pixels that hit, view by view."""
    for i in range(len(views)):
        row, column = np.nonzero(np.isfinite(views.depth[i]) & (views.depth[i] > 0))
        z = views.depth[i][row, column].astype(np.float64)
        ray = np.stack([(column - views.K[i, 0, 2]) / views.K[i, 0, 0],
                        (row - views.K[i, 1, 2]) / views.K[i, 1, 1], np.ones_like(z)], axis=1)
        yield (ray * z[:, None] - views.T[i]) @ views.R[i]


def check_sample(sample: StoredSample, manifest: Manifest, meshes: Path | None, n_cells: int,
                 seed: int) -> Iterator[Finding]:
    """All checks of one sample."""
    remade = remake(manifest, sample.facts, meshes)
    extent = manifest.normalise.extent
    occupancy = manifest.target == "occupancy"
    for res in manifest.resolutions:
        rng = np.random.default_rng([seed, res])
        tau = manifest.truncation(res)
        name = target_member(res)
        target = sample.octree(name)
        if not occupancy:
            found = check_cells(target, remade.views, Encoding.TSDF, tau, extent, TARGET_ERROR, n_cells, rng)
            yield Finding(sample.key, name, "cells", *found)
        kind = Encoding.OCCUPANCY if occupancy else Encoding.TSDF
        yield Finding(sample.key, name, "range", *check_range(target, kind))
        check = check_measured_surface if isinstance(manifest.source, SequenceSource) else check_surface
        surface = check(target, remade.views, kind, extent)
        yield Finding(sample.key, name, "surface", *surface)
        for variant in manifest.inputs:
            for encoding in variant.encodings:
                name = input_member(variant.name, encoding, res)
                octree = sample.octree(name)
                found = check_cells(octree, remade.observed[variant.name], encoding, tau, extent, INPUT_ERROR,
                                    n_cells, rng)
                yield Finding(sample.key, name, "cells", *found)
                yield Finding(sample.key, name, "range", *check_range(octree, encoding))


def run_check(url: str, meshes: Path | None, n_samples: int, n_cells: int, seed: int, every_row: bool,
              console: Console) -> bool:
    """Check some samples, drawn with a seed, and print what is wrong; whether all is right.

    Args:
        url: the data set.
        meshes: the folder that the meshes were read from; None where they are procedural, or where the
            manifest says it.
        n_samples: how many.
        n_cells: voxels of each octree.
        seed: of the draw of samples and voxels.
        every_row: print what is right, too.
        console: to print to.

    Raises:
        OcnfError: there is no data set or no sample, or the meshes are missing or have changed.
    """
    manifest = Manifest.from_dict(load_dataset(url).manifest)
    root = manifest.meshes_root(meshes)
    everything = list(stored_samples(url))
    chosen = random.Random(seed).sample(everything, min(n_samples, len(everything)))
    checks: list[Finding] = []
    for i, sample in enumerate(chosen):
        console.print(f"checking {sample.key} ({i + 1} of {len(chosen)})", style="dim", markup=False)
        checks += check_sample(sample, manifest, root, n_cells, seed)
    wrong = [check for check in checks if not check.ok]
    if every_row or wrong:
        table = Table("sample", "member", "check", "found", "")
        for check in checks if every_row else wrong:
            table.add_row(check.key, check.member, check.check, check.found,
                          "[green]ok[/]" if check.ok else "[red]WRONG[/]")
        console.print(table)
    console.print(f"{len(checks) - len(wrong)} of {len(checks)} checks of {len(chosen)} samples passed",
                  style="red" if wrong else "green")
    return bool(checks) and not wrong
