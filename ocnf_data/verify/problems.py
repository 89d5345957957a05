"""The outcome of a verification, and how it is shown."""

from __future__ import annotations

from dataclasses import dataclass, field

from rich.console import Console

from ocnf_data.shards.dataset import DatasetInfo
from ocnf_data.shards.index import is_shard

_MOST_ROWS = 200


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong.

    Attributes:
        file: its path in the data set; for a shard's index, that of the shard.
        code: machine-readable: `missing`, `truncated`, `header`, `checksum`, `padding`, `trailer`, `sha256`,
            `index`, `missing_index`, `json`, `octree`, `count`, `duplicate`, `extra`, ...
        what: a clause.
        key, member: the sample and its member, where it is about one.
        offset: the byte in the tar where it begins.
    """

    file: str
    code: str
    what: str
    key: str | None = None
    member: str | None = None
    offset: int | None = None

    def __str__(self) -> str:
        """`train/shard-000007.tar: chair_0001.target-64.oct at byte 1536: checksum: the payload has ...`."""
        subject = ".".join(part for part in (self.key, self.member) if part)
        place = "" if self.offset is None else f"at byte {self.offset}"
        parts = (self.file, f"{subject} {place}".strip(), self.code, self.what)
        return ": ".join(part for part in parts if part)


@dataclass
class VerifyReport:
    """What was looked at, and everything that is wrong with it; `notes` are no errors."""

    url: str
    info: DatasetInfo | None = None
    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    shards: int = 0
    samples: int = 0
    members: int = 0
    size: int = 0

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    @property
    def damaged_shards(self) -> list[str]:
        """Paths of the listed shards that have a problem, in the tar or in the index."""
        return sorted({problem.file for problem in self.problems
                       if is_shard(problem.file) and problem.code != "extra"})

    def add(self, file: str, code: str, what: str, key: str | None = None) -> None:
        """Note a problem that lies outside the shards' bytes."""
        self.problems.append(Problem(file, code, what, key))


def print_verify(report: VerifyReport, console: Console) -> int:
    """Show a report; the exit status of `ocnf-data verify`: 0 where nothing is wrong, else 1."""
    for note in report.notes:
        console.print(f"note: {note}", style="dim", markup=False, highlight=False)
    looked = (f"{report.shards} shards, {report.samples} samples, {report.members} members, "
              f"{report.size / 1e6:.1f} MB")
    if report.ok:
        console.print(f"[green]whole[/]: {looked}", highlight=False)
        return 0
    for problem in report.problems[:_MOST_ROWS]:  # lines: a table cuts names in a narrow terminal or a log
        console.print(str(problem), markup=False, highlight=False, soft_wrap=True)
    if len(report.problems) > _MOST_ROWS:
        console.print(f"... and {len(report.problems) - _MOST_ROWS} more", highlight=False)
    found = "1 problem" if len(report.problems) == 1 else f"{len(report.problems)} problems"
    console.print(f"[red]{found}[/] in {looked}", highlight=False)
    if report.damaged_shards:
        console.print("`ocnf-data repair` sets the damaged shards aside and generates exactly those again",
                      highlight=False)
    return 1
