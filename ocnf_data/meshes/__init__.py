"""Where meshes come from: files, folders of them, and procedural shapes."""

from ocnf_data.meshes.listing import list_modelnet
from ocnf_data.meshes.normalise import normalise
from ocnf_data.meshes.read import Mesh, read_mesh
from ocnf_data.views.normalisation import Normalisation

__all__ = ["Mesh", "Normalisation", "list_modelnet", "normalise", "read_mesh"]
