"""Which meshes make up a data set, split by split: the `source` of a manifest.

Four kinds: `shapes` (procedural, no files), `modelnet` (`ROOT/category/folder/*.off`), `folder` (every mesh
anywhere below a folder) and `list` (explicit paths). Each gives its `entries` in a fixed order, and none of
them may name the same mesh twice, in one split or in two.
"""

from ocnf_data.selection.entries import SPLITS, Entry, no_root
from ocnf_data.selection.explicit import ListSource
from ocnf_data.selection.folder import FolderSource
from ocnf_data.selection.modelnet import ModelNetSource
from ocnf_data.selection.shapes import ShapesSource

__all__ = ["SPLITS", "Entry", "FolderSource", "ListSource", "ModelNetSource", "ShapesSource", "no_root"]
