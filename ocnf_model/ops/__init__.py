"""Operations on `OctreeBatch`, each equal to a dense one, then the mean over each leaf (SEMANTICS 4)."""

from ocnf_model.ops.blend import FusionBlend
from ocnf_model.ops.concat import concat
from ocnf_model.ops.context import DenseContext
from ocnf_model.ops.conv import OctreeConv3d, octree_conv
from ocnf_model.ops.pool import grid_pool
from ocnf_model.ops.split import split_surface
from ocnf_model.ops.unpool import grid_unpool

__all__ = ["DenseContext", "FusionBlend", "OctreeConv3d", "concat", "grid_pool", "grid_unpool", "octree_conv",
           "split_surface"]
