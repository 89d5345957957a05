"""Grid-octrees: the structure, its files, its codec and its symmetries."""

from ocnf_data.octree.grid import GridOctree, mean_on, split_structure

__all__ = ["GridOctree", "mean_on", "split_structure"]
