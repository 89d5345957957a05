"""The metric of Firman et al.: overlap, precision and recall of what one view does not show to be free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ocnf_data.arrays import Bool
from ocnf_data.errors import OcnfError


@dataclass(frozen=True)
class Scores:
    """Figures of a frame, or their unweighted mean over frames; each in [0, 1].

    Attributes:
        iou: |truth and prediction| / |truth or prediction|.
        precision: true positives / predicted; 0 where nothing is predicted.
        recall: true positives / occupied; 0 where nothing is occupied.
    """

    iou: float
    precision: float
    recall: float

    @classmethod
    def of(cls, occupied: Bool, predicted: Bool, judged: Bool) -> Scores:
        """The figures of a frame; all three (D, H, W) bool, and voxels that are not judged do not count.

        Raises:
            OcnfError: the three differ in size.
        """
        if not occupied.shape == predicted.shape == judged.shape:
            raise OcnfError("volumes differ in size", where="Scores", field="predicted",
                            found=predicted.shape, expected=f"{occupied.shape}")
        truth, guess = occupied[judged], predicted[judged]
        both = int(np.count_nonzero(truth & guess))
        return cls(_share(both, int(np.count_nonzero(truth | guess))),
                   _share(both, int(np.count_nonzero(guess))), _share(both, int(np.count_nonzero(truth))))

    @classmethod
    def mean(cls, scores: Sequence[Scores]) -> Scores:
        """The unweighted mean over frames; OcnfError (`empty`) where there are none."""
        if not scores:
            raise OcnfError("no frames to average", code="empty", where="Scores")
        return cls(*(float(np.mean([getattr(one, name) for one in scores]))
                     for name in ("iou", "precision", "recall")))


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0
