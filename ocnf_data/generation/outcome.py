"""The outcome of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from rich.markup import escape
from rich.table import Table

from ocnf_data.generation.plan import Plan
from ocnf_data.generation.records import Failure
from ocnf_data.manifest import SPLITS, Manifest
from ocnf_data.manifest.folder import FolderSource


def split_notes(plan: Plan, manifest: Manifest, splits: Sequence[str] = SPLITS) -> list[str]:
    """What is to be known of the splits before hours go into a data set: a sentence each.

    Args:
        plan: of the data set.
        manifest: that it was made from.
        splits: those that are to be made.
    """
    counts = {split: sum(len(shard.items) for shard in plan.shards if shard.split == split)
              for split in plan.splits}
    asked = manifest.source.asked if isinstance(manifest.source, FolderSource) else ()
    notes = [f"no mesh is left for {split}: {sum(counts.values())} in all, and source.shares asks for "
             f"{', '.join(asked)}" for split in asked if split in splits and split not in counts]
    if "train" in counts and "val" not in counts and "val" in splits:
        notes.append("there is no split val: `ocnf-model train` validates with one, this data set's or, by "
                     "--val, another's")
    return notes


@dataclass(frozen=True)
class Report:
    """What `generate` returns: `items = samples + len(failures) + len(exclusions)`.

    Attributes:
        out: the data set's URL.
        items: inputs that the manifest names.
        samples: number of inputs that became samples.
        failures: why the others did not; their rows are in `failures.jsonl`, with those of `exclusions`.
        exclusions: inputs that were left out on purpose, such as a file listed twice.
        made: samples and failures of this run; the rest was there already.
        bytes: size of all shards together, in bytes.
        seconds: this run's wall time.
        threshold: share of failed items that the manifest allows.
        warnings: sentences.
    """

    out: str
    items: int
    samples: int
    failures: tuple[Failure, ...]
    exclusions: tuple[Failure, ...]
    made: int
    bytes: int
    seconds: float
    threshold: float
    warnings: tuple[str, ...] = field(default=())

    @property
    def failed_share(self) -> float:
        """Failures over the items that were tried."""
        return len(self.failures) / max(self.samples + len(self.failures), 1)

    @property
    def ok(self) -> bool:
        """Whether no more items failed than the manifest allows, and there is a sample at all."""
        return self.samples > 0 and self.failed_share <= self.threshold

    @property
    def per_minute(self) -> float:
        """Items of this run a minute."""
        return 60 * self.made / max(self.seconds, 1e-9)

    def table(self) -> Table:
        """A summary to print."""
        table = Table(title=escape(self.out), show_header=False, title_justify="left")
        table.add_column(style="bold")
        table.add_column(justify="right")
        table.add_row("items", f"{self.items:,}")
        table.add_row("samples", f"{self.samples:,}")
        table.add_row("failures", f"{len(self.failures):,}", style="red" if self.failures else None)
        for (stage, code), n in Counter((f.stage, f.code) for f in self.failures).most_common():
            table.add_row(f"  {code} ({stage})", f"{n:,}")
        if self.exclusions:
            table.add_row("exclusions", f"{len(self.exclusions):,}")
        table.add_row("size of the shards", f"{self.bytes / 1e6:,.1f} MB")
        table.add_row("made in this run", f"{self.made:,}")
        table.add_row("time", f"{self.seconds:,.1f} s")
        if self.made:
            table.add_row("items a minute", f"{self.per_minute:,.1f}")
        return table
