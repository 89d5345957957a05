"""Accounting for every input: what was planned is a sample or a failure, exactly once.

    inputs = samples + failures + exclusions

`plan.json` lists the items by shard, and the exclusions; `failures.jsonl` has a row for each failure and each
exclusion; `failures/*.jsonl` are the rows shard by shard, which a resumed run starts from.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Iterable
from typing import Any

from ocnf_data.files.storage import Store
from ocnf_data.shards.dataset import FAILURES, PLAN
from ocnf_data.verify.problems import VerifyReport

_MAX_TEXT_BYTES = 2**30  # the plan of a million mesh files has some 270 MB


def check_account(store: Store, report: VerifyReport, names: Iterable[str], samples: set[str]) -> None:
    """Report every input that is lost, counted twice, or came from nowhere.

    Args:
        store: the data set's folder.
        report: where to report; `info` is what `dataset.json` says, if it is there.
        names: all files of the data set.
        samples: the keys of all samples.
    """
    # exists, not only listed: to open a pipe under one of these names would wait for ever
    rows = _read_rows(store, report, FAILURES) if store.exists(FAILURES) else []
    plan = _read_plan(store, report) if store.exists(PLAN) else None
    for name in sorted(name for name in set(names) if name.startswith("failures/") and store.exists(name)):
        for row in _read_rows(store, report, name):
            if report.info is not None and row not in rows:
                report.add(name, "count", f"a row that {FAILURES} does not have", row["item"])
            elif report.info is None:  # unfinished: nobody has put the rows together yet
                rows.append(row)
    if report.info is not None:
        counts = report.info.counts
        if len(rows) != counts.failures + counts.exclusions:
            report.add(FAILURES, "count", f"{len(rows)} rows, where dataset.json has {counts.failures} "
                                          f"failures and {counts.exclusions} exclusions")
    if plan is None:
        return
    planned, exclusions = plan
    fate = Counter(samples)
    fate.update(row["item"] for row in rows if row["item"] in planned)
    if report.info is not None:
        for key in planned - fate.keys():
            report.add(FAILURES, "count", "planned, but neither a sample nor a failure", key)
        if (len(planned), exclusions) != (expected := (counts.items - counts.exclusions, counts.exclusions)):
            report.add(PLAN, "count", f"{len(planned)} items and {exclusions} exclusions, where dataset.json "
                                      f"has {expected[0]} and {expected[1]}")
    for key, number in fate.items():
        if key not in planned:
            report.add(PLAN, "count", "a sample that was not planned", key)
        elif number > 1:
            report.add(FAILURES, "count", f"accounted for {number} times", key)


def _read_rows(store: Store, report: VerifyReport, name: str) -> list[dict[str, str]]:
    """The rows of a file of failures; a row that cannot be read is reported."""
    if store.size(name) > _MAX_TEXT_BYTES:
        report.add(name, "too_large", "too large to be read")
        return []
    rows = []
    for number, line in enumerate(store.read_bytes(name).splitlines(), start=1):
        row = _parsed(line)
        if isinstance(row, dict) and all(isinstance(row.get(part), str) for part in
                                         ("item", "stage", "code", "message")):
            rows.append(row)
        else:
            report.add(name, "invalid", f"line {number} is no failure row")
    return rows


def _read_plan(store: Store, report: VerifyReport) -> tuple[set[str], int] | None:
    """(keys of all items, number of exclusions), or None where the file is no plan."""
    plan: Any = _parsed(store.read_bytes(PLAN)) if store.size(PLAN) <= _MAX_TEXT_BYTES else None
    try:
        keys = [item["key"] for split in plan["shards"].values() for shard in split for item in shard]
        planned, exclusions = set(keys), len(plan["exclusions"])
    except (AttributeError, LookupError, TypeError):
        report.add(PLAN, "invalid", "not a plan")
        return None
    if len(planned) != len(keys):
        report.add(PLAN, "duplicate", "two items have the same key")
    return planned, exclusions


def _parsed(text: bytes) -> Any:
    """The JSON value; None for what is no JSON."""
    with contextlib.suppress(ValueError, RecursionError):
        return json.loads(text)
    return None
