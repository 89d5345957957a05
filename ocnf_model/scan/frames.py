"""What of a scan's frames is used."""

from __future__ import annotations

from dataclasses import replace
from numbers import Real

import numpy as np

from ocnf_data.errors import OcnfError
from ocnf_data.views.scans import Scan


def limit_depth(scan: Scan, farthest: float | None) -> Scan:
    """The scan with all that was measured beyond `farthest` metres taken for not measured; None: all of it.

    A ray that is known to be free (`inf`) stays free.

    Raises:
        OcnfError: not a depth, or nothing is left (`empty`).
    """
    if farthest is None:
        return scan
    if not (isinstance(farthest, Real) and farthest > 0):  # NaN is refused too
        raise OcnfError("not a depth", field="max_depth", found=farthest, expected="metres, above 0")
    depth = scan.views.depth
    near = np.where((depth <= farthest) | np.isinf(depth), depth, np.float32(0))
    if not ((near > 0) & np.isfinite(near)).any():
        measured = depth[(depth > 0) & np.isfinite(depth)]
        raise OcnfError("nothing was measured as near as this", code="empty", field="max_depth",
                        found=f"{farthest:g} m",
                        expected=f"at least {measured.min():.3g} m" if measured.size else None)
    return replace(scan, views=scan.views.with_depth(near))
