"""Which epoch is best: the one with the least cost on the validation samples."""

from __future__ import annotations

from enum import StrEnum

from ocnf_model.training.train_state import EpochRow


class BestBy(StrEnum):
    """What the best checkpoint of a level has the least, or the most, of."""

    MAD = "mad"
    """The least mean error of all voxels. Most of it lies in large unseen parts, so it flatters a network
    that makes little of the surface."""
    IOU = "iou"
    """The most intersection over union of what is occupied."""
    F_SCORE = "f_score"
    """The most F-score of the surface at one voxel."""
    MAD_AND_F_SCORE = "mad_and_f_score"
    """The least MAD * (1 - F-score): a tenth less of the one error is worth a tenth more of the other."""

    def cost(self, mad: float, iou: float, f_score: float) -> float:
        """What is to be small."""
        if self is BestBy.MAD:
            return mad
        if self is BestBy.IOU:
            return -iou
        if self is BestBy.F_SCORE:
            return -f_score
        return mad * (1 - f_score)


def is_better(row: EpochRow, best: EpochRow | None, by: BestBy) -> bool:
    """Whether an epoch is better than the best before it; by MAD where that one's F-score is not known.

    Args:
        row: of the epoch; its `best` is not looked at.
        best: of the level so far; None at its beginning.
        by: the measure.
    """
    if best is None:
        return True
    if row.val_f_score is None or best.val_f_score is None:  # begun by a version that did not measure it
        return row.val_mad < best.val_mad
    return by.cost(row.val_mad, row.val_iou, row.val_f_score) < by.cost(best.val_mad, best.val_iou,
                                                                         best.val_f_score)
