"""What is to be done, as it is printed: steps with their time and disk."""

from __future__ import annotations

from dataclasses import dataclass

from ocnf_model.tables.rates import Estimate
from ocnf_model.tables.steps import Step


@dataclass(frozen=True)
class TablePlan:
    """What is to be done.

    Attributes:
        steps: all steps, in order.
        left: those that are not done.
        estimates: what those that are left take, by name; empty where nothing was measured.
        notes: a sentence for each table that cannot be made.
    """

    steps: list[Step]
    left: list[Step]
    estimates: dict[str, Estimate]
    notes: list[str]

    def lines(self) -> list[str]:
        """A line a step that is left, and the sum."""
        found = []
        for step in self.left:
            estimate = self.estimates.get(step.name)
            found.append(step.name if not self.estimates else f"{step.name}: not measured" if estimate is None
                         else f"{step.name}: {duration(estimate.seconds)}, {megabytes(estimate.size)}")
        done = len(self.steps) - len(self.left)
        seconds = sum(one.seconds for one in self.estimates.values())
        size = sum(one.size for one in self.estimates.values())
        total = f": {duration(seconds)}, {megabytes(size)}" if self.estimates else ""
        return [*found, f"{len(self.left)} steps to do, {done} done before{total}"]


def duration(seconds: float) -> str:
    """Seconds in words."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def megabytes(size: float) -> str:
    """Bytes in words."""
    return f"{size / 1e6:.1f} MB" if size < 1e9 else f"{size / 1e9:.1f} GB"
