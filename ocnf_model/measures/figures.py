"""Measures of a surface that people know, and the recall of what is thin."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan

import numpy as np

from ocnf_model.measures.reference import Reference
from ocnf_model.measures.surface import Surface, sample_triangles

THIN, THICK = 1.5, 3.0
THICKNESS_BINS: dict[str, tuple[float, float]] = {
    "recall_thin": (0.0, THIN), "recall_medium": (THIN, THICK), "recall_thick": (THICK, inf)}
"""Bounds of the local thickness, in voxels of the resolution that is measured: at least, and less than."""
_FEWEST = 30  # samples in a bin; a recall of fewer says nothing


@dataclass(frozen=True)
class SurfaceFigures:
    """How a surface lies to the true one. Distances go from samples of either surface to the other surface.

    Attributes:
        chamfer_voxels: Chamfer distance: the mean distance from the reconstruction to the truth and that from
            the truth to the reconstruction, averaged; in voxels of the resolution.
        chamfer_mm: the same in millimetres of the normalised cube.
        f_score: F-score at one voxel: the harmonic mean of `surface_precision` and `surface_recall`.
        surface_precision: share of the reconstructed surface within one voxel of the true one.
        surface_recall: share of the true surface within one voxel of the reconstructed one.
        normal_consistency: |cosine| between a sample's normal and the normal where the other surface is
            nearest, mean over the samples of both directions, averaged; the sign is left out as the windings
            of meshes mean nothing. 1 is best, 0.5 is what random directions have.
        recall_thin: `surface_recall` of the true surface whose local thickness is less than 1.5 voxels of the
            resolution.
        recall_medium: of that from 1.5 up to 3 voxels.
        recall_thick: of that from 3 voxels on.

    A recall is NaN where the model has fewer than 30 of 30,000 samples of such thickness. Without a
    reconstructed surface distances are the cube's size, shares 0; without any true one, too, all is well.
    """

    chamfer_voxels: float = nan
    chamfer_mm: float = nan
    f_score: float = nan
    surface_precision: float = nan
    surface_recall: float = nan
    normal_consistency: float = nan
    recall_thin: float = nan
    recall_medium: float = nan
    recall_thick: float = nan


def measure_surface(found: Surface, reference: Reference, voxel: float, extent: float) -> SurfaceFigures:
    """Compare a reconstructed surface with the true one.

    Args:
        found: the reconstruction, in metres.
        reference: the truth, in metres.
        voxel: size of a voxel of the reconstruction's resolution in metres: the threshold.
        extent: size of the cube in metres: the distance to what does not exist.
    """
    there, true = found.samples, reference.samples
    if not len(there) or not len(true):
        equal = len(there) == len(true)
        share = float(equal)
        empty = np.zeros(len(true), bool)
        far = 0.0 if equal else extent
        return SurfaceFigures(far / voxel, 1000 * far, share, share, share, share,
                              *_recalls(empty, reference, voxel))
    to_truth, true_normals = reference.surface.nearest(there.points)
    to_found, found_normals = found.nearest(true.points)
    precision, recall = float((to_truth <= voxel).mean()), float((to_found <= voxel).mean())
    chamfer = float(to_truth.mean() + to_found.mean()) / 2
    agree = [np.abs((a * b).sum(axis=1)).mean() for a, b in ((there.normals, true_normals),
                                                             (true.normals, found_normals))]
    return SurfaceFigures(
        chamfer_voxels=chamfer / voxel, chamfer_mm=1000 * chamfer,
        f_score=_harmonic(precision, recall),
        surface_precision=precision, surface_recall=recall, normal_consistency=float(np.mean(agree)),
        **dict(zip(THICKNESS_BINS, _recalls(to_found <= voxel, reference, voxel), strict=True)))


def f_score(found: Surface, true: Surface, threshold: float, n: int = 10_000) -> float:
    """The F-score alone, by fewer samples: for validation during training.

    Args:
        found: the reconstruction.
        true: the truth.
        threshold: within which a sample counts, in the units of both.
        n: samples of each.
    """
    there, here = (sample_triangles(surface.triangles, n) for surface in (found, true))
    if not len(there) or not len(here):
        return float(len(there) == len(here))
    precision = float((true.nearest(there.points)[0] <= threshold).mean())
    recall = float((found.nearest(here.points)[0] <= threshold).mean())
    return _harmonic(precision, recall)


def _harmonic(a: float, b: float) -> float:
    return 2 * a * b / (a + b) if a + b else 0.0


def _recalls(reached: np.ndarray, reference: Reference, voxel: float) -> list[float]:
    """The share of the true samples that are reached, in each of `THICKNESS_BINS`."""
    thickness = reference.thickness / voxel
    bins = [(low <= thickness) & (thickness < high) for low, high in THICKNESS_BINS.values()]
    bins[-1] |= np.isinf(thickness)
    return [float(reached[one].mean()) if one.sum() >= _FEWEST else nan for one in bins]
