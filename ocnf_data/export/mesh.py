"""Surfaces as PLY files: that of the ground truth, and that of plain fusion where it is stored."""

from __future__ import annotations

import numpy as np

from ocnf_data.arrays import F64, I64
from ocnf_data.errors import OcnfError
from ocnf_data.export.sample import ExportSample
from ocnf_data.export.settings import Coordinates
from ocnf_data.meshes.writing import WRITERS
from ocnf_data.octree import TARGET
from ocnf_data.octree.surface import octree_surface
from ocnf_data.sequences.known import known_surface


def surface_meshes(sample: ExportSample) -> dict[str, tuple[F64, I64]]:
    """Marching cubes of the ground truth, `target`, and of each TSDF input (VolFus), by its variant.

    Returns:
        vertices (N, 3), x y z in metres, and faces (M, 3), closed and facing outwards; of scans what was
        measured, which is open where no frame has looked. An input may come out empty; it is then left out.

    Raises:
        OcnfError: the ground truth is occupancy, or has no surface (`empty`); scikit-image is missing.
    """
    surface = known_surface if sample.is_of_scan else octree_surface
    meshes = {TARGET: surface(sample.truth(), sample.extent)}
    if not len(meshes[TARGET][1]):
        raise OcnfError("the ground truth has no surface", code="empty", where=sample.key,
                        fix="a finer resolution keeps thinner parts")
    for variant, member in sample.tsdf_inputs.items():
        vertices, faces = surface(sample.octree(member), sample.extent)
        if len(faces):
            meshes[variant] = vertices, faces
    return meshes


def mesh_files(sample: ExportSample) -> dict[str, bytes]:
    """The files of a sample: `KEY.VARIANT.ply` for each TSDF input, and `KEY.ply`."""
    meshes = surface_meshes(sample)
    frame = sample.frame(Coordinates.METRES, lambda: float(np.linalg.norm(meshes[TARGET][0], axis=1).max()))
    stem = f"{sample.stored.split}/{sample.key}"
    return {f"{stem}.ply" if name == TARGET else f"{stem}.{name}.ply":
            WRITERS[".ply"](vertices * frame.factor, faces) for name, (vertices, faces) in meshes.items()}
