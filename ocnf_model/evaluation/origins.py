"""Models made again from what they were made of: the mesh, and which voxels the input views saw."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ocnf_data.encodings import Encoding
from ocnf_data.fusion import fuse_histogram
from ocnf_data.octree import GridOctree
from ocnf_data.shards.dataset import load_dataset
from ocnf_model.evaluation.models import DatasetFacts, Model
from ocnf_model.measures.reference import Reference
from ocnf_model.measures.regions import seen_by
from ocnf_model.octree.batch import OctreeBatch

if TYPE_CHECKING:
    from ocnf_data.generation.remake import Remade

SHAPES = "shapes"
"""The kind of source that needs no files."""


class Origins:
    """Makes the models of a data set again: its mesh, clean views and noisy views.

    Args:
        facts: what the manifest of the data set says.
        meshes: the folder that its meshes were read from; None: only procedural shapes can be made again.
    """

    def __init__(self, facts: DatasetFacts, meshes: Path | None) -> None:
        self._facts, self._meshes = facts, meshes
        self.available = meshes is not None or facts.source == SHAPES
        self._made: tuple[str, Remade] | None = None

    def reference(self, model: Model, truth: GridOctree, longest: float) -> Reference:
        """The mesh's own surface, as far as the views of the rig see it.

        Args:
            model: the model to make again.
            truth: the model's ground truth at the finest resolution, negative inside.
            longest: largest thickness in metres; one above is infinite.

        Raises:
            OcnfError: the mesh is missing, or not the one that the sample was made of.
        """
        origin = self._origin(model)
        return Reference.of_mesh(origin.vertices[origin.mesh.faces], origin.views, truth, self._facts.extent,
                                 longest)

    def seen(self, model: Model, variant: str, resolution: int) -> OctreeBatch | None:
        """1 where a view of the variant counts for a voxel, 0 elsewhere."""
        views = self._origin(model).observed[variant]
        histogram = fuse_histogram(views, resolution, self._facts.extent, self._facts.taus[resolution])
        return seen_by(OctreeBatch.from_grids([histogram]), Encoding.HISTOGRAM)

    def _origin(self, model: Model) -> Remade:
        if self._made is None or self._made[0] != model.key:
            from ocnf_data.generation.remake import remake
            from ocnf_data.manifest import Manifest

            manifest = Manifest.from_dict(load_dataset(self._facts.url).manifest)
            self._made = model.key, remake(manifest, model.facts, self._meshes)
        return self._made[1]
