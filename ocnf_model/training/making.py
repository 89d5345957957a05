"""The validation samples of a manifest, which are made once, before a run begins."""

from __future__ import annotations

import os
from pathlib import Path

from rich.console import Console

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.generation import Report, generate
from ocnf_data.manifest import Manifest
from ocnf_data.shards.dataset import DATASET, FAILURES
from ocnf_model.training.record import VALIDATION, is_begun

_MOST_JOBS = 8
_MOST_NAMED = 5  # failures


def make_validation(manifest: Manifest, root: Path | None, folder: Path, split: str,
                    console: Console) -> None:
    """Make the validation set in the folder of a run, if it is not there yet, and say what failed of it.

    Args:
        manifest: what is made, without what is drawn for training.
        root: the folder that its paths are relative to.
        folder: folder of the run.
        split: the manifest's split that is validated with.
        console: where failures are said.

    Raises:
        OcnfError: code `too_many_bad`: none could be made, or fewer than the manifest's
            `limits.failure_threshold` asks for. A run that was begun with those there are goes on.
    """
    made = folder / VALIDATION
    if not Store(made).exists(DATASET):
        console.print(f"making the validation set in {made}", highlight=False)
    report = generate(manifest, made, root, jobs=min(os.cpu_count() or 1, _MOST_JOBS), splits=(split,),
                      progress=console.is_terminal)
    for line in _said_of_failures(report, made / FAILURES):
        console.print(line, highlight=False, markup=False)
    if not report.ok and not is_begun(folder):
        raise OcnfError("too few of the validation samples could be made", code="too_many_bad",
                        where=made / FAILURES, found=f"{report.samples} of {report.items}",
                        expected=f"all but a share of {report.threshold:g}, and at least one",
                        fix="look at the reasons there and take the bad inputs out of the split, with a new "
                            "--out; or raise limits.failure_threshold of the manifest, or name a data set "
                            "with --val")


def _said_of_failures(report: Report, where: Path) -> list[str]:
    """How many failed, and why the first ones did: a line each."""
    if not report.failures:
        return []
    tried = report.samples + len(report.failures)
    lines = [f"{len(report.failures)} of {tried} validation samples could not be made: see {where}"]
    lines += [f"  {failure.source}: {failure.code} ({failure.stage}): {' '.join(failure.message.split())}"
              for failure in report.failures[:_MOST_NAMED]]
    if (more := len(report.failures) - _MOST_NAMED) > 0:
        lines.append(f"  and {more} more")
    return lines
