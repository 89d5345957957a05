"""2x2x2 nearest-neighbour unpooling, plain or onto a given structure (SEMANTICS 4)."""

from __future__ import annotations

from ocnf_data.errors import OcnfError
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.resample import doubled
from ocnf_model.octree.structure import Structure


def grid_unpool(x: OctreeBatch, guide: OctreeBatch | Structure | None = None) -> OctreeBatch:
    """Twice the resolution: every leaf doubles its width; one of width 8 becomes 8 trees of one leaf.

    Args:
        x: features at half the resolution.
        guide: a batch or structure of twice the resolution of `x` and at least as fine as the plain
            result; the features are put onto its structure.

    Raises:
        OcnfError: the guide has another size, or is coarser somewhere.
    """
    if guide is None:
        structure = doubled(x.structure)
    else:
        structure = guide.structure if isinstance(guide, OctreeBatch) else guide
        twice = tuple(2 * n for n in x.structure.grid)
        if not isinstance(structure, Structure) or structure.grid != twice:
            raise OcnfError("sizes do not fit", where="grid_unpool", field="guide",
                            found=structure.describe() if isinstance(structure, Structure)
                            else type(structure).__name__,
                            expected=f"twice the size of {x.structure.describe()}")
    return OctreeBatch(structure, x.map_to(structure)(x.features))  # (L, C) -> (L of structure, C)
