"""Grid-octrees: the structure, its files, its codec and its symmetries."""

from ocnf_data.octree.codec import decode, decode_raw, encode, encode_raw
from ocnf_data.octree.grid import GridOctree, mean_on
from ocnf_data.octree.stored import TARGET, RawOctree, quantise
from ocnf_data.octree.symmetry import ROTATIONS, SYMMETRIES, Symmetry

__all__ = [
    "ROTATIONS",
    "SYMMETRIES",
    "TARGET",
    "GridOctree",
    "RawOctree",
    "Symmetry",
    "decode",
    "decode_raw",
    "encode",
    "encode_raw",
    "mean_on",
    "quantise",
]
