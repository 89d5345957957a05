"""The encoding of the next resolution, as a level before it reads it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ocnf_data.encodings import Encoding
from ocnf_model.octree.batch import OctreeBatch
from ocnf_model.octree.structure import Structure
from ocnf_model.ops import grid_pool
from ocnf_model.ops.pool import Pooling

GAIN = 8.0
"""What is read is multiplied by it. In a trained network that begins to read it weights start at zero, and
Adam, whose steps are all alike, would take thousands of them to let them count."""
_ROOT_ALONE = np.array([1, 0], np.uint64)  # a tree whose root is split and none of its children


def pooled_encoding(finer: OctreeBatch) -> OctreeBatch:
    """An encoding at half its resolution: each voxel the mean of eight, times `GAIN`.

    A voxel has the vote of one pixel a view. Where it covers many, eight finer ones say more: what is thin is
    missed less often, and noise is averaged.

    Pooling makes one tree of eight, split at its root even where all eight are alike, as in free space. Those
    are joined again, or half of a structure would be leaves in which nothing changes.
    """
    pooled = grid_pool(finer, Pooling.MEAN)
    trees, first = pooled.structure.flat, pooled.structure.prefix[:-1]
    eights = np.flatnonzero((trees == _ROOT_ALONE).all(axis=1))
    rows = torch.from_numpy(first[eights, None] + np.arange(8)).to(pooled.device)  # (N, 8)
    values = pooled.features[rows]                                                 # (N, 8, C)
    alike = (values == values[:, :1]).all(dim=2).all(dim=1)                        # (N,)
    joined = trees.copy()
    joined[eights[alike.cpu().numpy()]] = 0
    keep = torch.ones(len(pooled.features), dtype=torch.bool, device=pooled.device)
    keep[rows[alike][:, 1:].reshape(-1)] = False
    return OctreeBatch(Structure(joined.reshape(pooled.structure.trees.shape)), GAIN * pooled.features[keep])


def guessed_encoding(encoded: OctreeBatch, encoding: Encoding) -> OctreeBatch:
    """What `pooled_encoding` would say of the next resolution, guessed from this one where there is none.

    The truncation is as many voxels at each resolution, so that it halves: distances count twice as much, and
    are cut off there. What finer voxels say more than this is not known.

    Args:
        encoded: an encoding; channels behind the encoding's stay as they are.
        encoding: which.
    """
    values = encoded.features[:, :encoding.channels]
    if encoding is Encoding.HISTOGRAM:
        values = values @ _votes_at_half_the_truncation().to(values)
    elif encoding is Encoding.TSDF:
        values = (2 * values).clamp(-1, 1)
    elif encoding is Encoding.TDF_OCCUPANCY:
        values = torch.cat([(2 * values[:, :1]).clamp(max=1), values[:, 1:]], 1)
    extra = encoded.features[:, encoding.channels:]
    return encoded.with_features(GAIN * torch.cat([values, extra], 1))


def _votes_at_half_the_truncation() -> Tensor:
    """(10, 10): where the votes of each bin fall (SEMANTICS 2) if the truncation is half as far."""
    bins = torch.arange(Encoding.HISTOGRAM.channels)
    middle = bins[-1] / 2
    places = (2 * bins - middle).clamp(bins[0], bins[-1])  # of twice the centres, in bins
    return (1 - (places[:, None] - bins).abs()).clamp(min=0)
