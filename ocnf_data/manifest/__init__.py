"""What a data set is: a typed YAML manifest, and which meshes or scans make up its splits.

A manifest's `source` has seven kinds: `shapes` and `scenes` (procedural, no files), `modelnet`
(`ROOT/category/folder/*.off`), `folder` (every mesh anywhere below a folder), `list` (explicit paths),
`mixture` (several of these, with weights) and `sequence` (scans: posed depth frames). Each gives its
`entries` in a fixed order; none may name the same mesh twice, in one split or in two.
"""

from ocnf_data.manifest.entries import SPLITS, Entry
from ocnf_data.manifest.schema import Manifest, Target, Variant, load_manifest, manifest_difference

__all__ = ["SPLITS", "Entry", "Manifest", "Target", "Variant", "load_manifest", "manifest_difference"]
