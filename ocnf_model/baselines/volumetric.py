"""VolFus: the truncated signed distance averaged over the views (Curless and Levoy 1996; SEMANTICS 2)."""

from __future__ import annotations

import numpy as np

from ocnf_data.encodings import Encoding
from ocnf_data.errors import OcnfError
from ocnf_data.octree import GridOctree


def volfus_from_encoding(octree: GridOctree, encoding: Encoding) -> GridOctree:
    """TSDF / tau in [-1, 1], 1 channel, of a stored input: TSDF as it is, or (1 - 2o) t of TDF and occupancy.

    From views it is what `ocnf_data.fuse_tsdf` gives. A histogram does not have it: votes of views up to
    1.125 tau in front of a surface are not cut at tau.

    Raises:
        OcnfError: another encoding, or an octree with other channels than it has.
    """
    encoding = Encoding(encoding)
    if encoding not in (Encoding.TSDF, Encoding.TDF_OCCUPANCY):
        raise OcnfError("VolFus cannot be computed from this encoding", where="volfus", field="encoding",
                        found=encoding, expected="tsdf or tdf_occupancy",
                        fix="add tsdf to the encodings of the data set's inputs")
    if octree.channels != encoding.channels:
        raise OcnfError("the octree is not in this encoding", where="volfus", field="channels",
                        found=octree.channels, expected=f"{encoding.channels} for {encoding}")
    if encoding is Encoding.TSDF:
        return octree
    distance, occupied = octree.data[:, :1], octree.data[:, 1:]
    return octree.with_data((np.float32(1) - np.float32(2) * occupied) * distance)
