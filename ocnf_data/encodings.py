"""The four input encodings of the paper (section 3.1)."""

from __future__ import annotations

from enum import StrEnum


class Encoding(StrEnum):
    """How depth views are written into the voxels of an input octree; all values lie in [-1, 1]."""

    OCCUPANCY = "occupancy"
    """1 channel: 1 = occupied or unseen, 0 = seen free."""
    TSDF = "tsdf"
    """1 channel: TSDF / tau, negative inside and where no view looked."""
    TDF_OCCUPANCY = "tdf_occupancy"
    """2 channels: |TSDF| / tau and [TSDF < 0]."""
    HISTOGRAM = "histogram"
    """10 channels: the share of the views that vote for each of 10 TSDF bins; they sum to 1."""

    @property
    def channels(self) -> int:
        """Channels a voxel."""
        return _CHANNELS[self]

    @property
    def span(self) -> float:
        """Largest possible value minus the smallest: what the split tolerance is relative to."""
        return 2.0 if self is Encoding.TSDF else 1.0


_CHANNELS = {Encoding.OCCUPANCY: 1, Encoding.TSDF: 1, Encoding.TDF_OCCUPANCY: 2, Encoding.HISTOGRAM: 10}
