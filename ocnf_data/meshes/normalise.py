"""Meshes scaled into the grid's cube (SEMANTICS 1)."""

from __future__ import annotations

from ocnf_data.arrays import F64, I64
from ocnf_data.meshes.read import Mesh
from ocnf_data.meshes.topology import bounding_box
from ocnf_data.views.normalisation import Normalisation


def normalise(mesh: Mesh, extent: float = 3.0, padding: float = 0.05) -> tuple[F64, Normalisation]:
    """Vertices (N, 3) in metres: the bounding box of the referenced ones centred, its longest edge scaled.

    Args:
        mesh: the mesh to scale.
        extent: edge length of the cube in metres.
        padding: share of it that stays free; the longest edge becomes `extent * (1 - padding)`.

    Raises:
        OcnfError: `degenerate` for a mesh without extent.
    """
    normalisation = fit_cube(mesh.vertices, mesh.faces, extent, padding)
    return normalisation.apply(mesh.vertices), normalisation


def fit_cube(vertices: F64, faces: I64, extent: float = 3.0, padding: float = 0.05) -> Normalisation:
    """The normalisation of `normalise`, for bare arrays."""
    low, high = bounding_box(vertices, faces, "mesh")
    return Normalisation(low + (high - low) / 2, extent * (1 - padding) / float((high - low).max()))
