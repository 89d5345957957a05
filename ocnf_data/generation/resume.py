"""Beginning and resuming: `plan.json` is written first, and a folder is continued with that plan only."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.generation.plan import PLAN_SCHEMA, Plan
from ocnf_data.generation.procedural import is_configuration, is_procedural
from ocnf_data.manifest import manifest_difference
from ocnf_data.shards.dataset import DATASET, PLAN

_SMALL_PLAN = 64 * 2**20  # bytes; larger ones are read if they are about as large as the plan to be followed
_LARGEST_PLAN = 2**30
_ELSEWHERE = "generate into another folder, or put it back as it was"
# They decide when to give up, not what comes out; and where meshes lie is no part of what they are.
_FREE_FIELDS = ("source.root", "limits.timeout_s", "limits.failure_threshold")


def adopt(store: Store, plan: Plan,
          by_chance_alone: Callable[[], Plan] | None = None) -> tuple[Plan, list[str]]:
    """The plan to follow: the one the folder was begun with; in a new folder this one, now written there.

    Args:
        store: the folder.
        plan: what the manifest gives today.
        by_chance_alone: what it gave before splits that chance had left empty were given a mesh; asked for
            only where the folder was begun with fewer splits, or with other meshes in them.

    Returns:
        The plan, and sentences to warn the user with.

    Raises:
        OcnfError: the folder was begun with another manifest, schema, library or mesh (the field is named),
            or holds shards without a plan.
    """
    where = store.where(PLAN)
    if not store.exists(PLAN):
        if store.exists(DATASET) or any(store.list(split) for split in plan.splits):
            raise OcnfError("the folder holds shards but no plan.json, so it cannot be resumed", where=where,
                            code="no_plan", fix="generate into an empty folder")
        with store.writing(PLAN) as path, path.open("wb") as file:
            file.writelines(plan.pieces())
        return plan, []
    begun = _read(store.read_at_most(PLAN, max(_SMALL_PLAN, 4 * len(plan.to_json()))), where)
    _compare_manifests(begun, plan, where)
    if by_chance_alone is not None and _places(begun) != _places(plan):
        older = by_chance_alone()
        if set(begun.splits) < set(plan.splits) or _places(begun) == _places(older):
            plan = older
    _compare("libraries", begun.fingerprint["libraries"], plan.fingerprint["libraries"], where,
             "use the versions it was begun with, or generate into another folder")
    _compare_items(begun, plan, where)
    warnings = []
    if begun.fingerprint["cpu"] != plan.fingerprint["cpu"]:
        warnings.append(f"begun on a {begun.fingerprint['cpu']}, resumed on a {plan.fingerprint['cpu']}: "
                        "the bytes should be the same, but that is tested on one type of CPU only")
    return begun, warnings


def read_plan(store: Store) -> Plan:
    """The plan that a folder was begun with.

    Raises:
        OcnfError: there is none (`missing`), or it is none.
    """
    return _read(store.read_at_most(PLAN, _LARGEST_PLAN), store.where(PLAN))


def _read(blob: bytes, where: str) -> Plan:
    try:
        raw = json.loads(blob)
        schema = raw["schema"]
    except (ValueError, TypeError, KeyError) as error:
        raise OcnfError("not a plan", code="invalid", where=where, found=error,
                        fix="restore the file, or generate into an empty folder") from error
    if schema != PLAN_SCHEMA:
        raise OcnfError("the folder was begun with another version of the format", code="changed",
                        where=where, field="schema", found=schema, expected=PLAN_SCHEMA, fix=_ELSEWHERE)
    try:
        return Plan.from_dict(raw)
    except (TypeError, KeyError, ValueError) as error:
        raise OcnfError(f"not a plan: {type(error).__name__}", code="invalid", where=where, found=error,
                        fix="restore the file, or generate into an empty folder") from error


def _compare_manifests(begun: Plan, plan: Plan, where: str) -> None:
    for changed in manifest_difference(begun.manifest, plan.manifest, ignore=_FREE_FIELDS):
        raise OcnfError("the manifest is not the one the folder was begun with", code="changed",
                        where=where, field=changed.field, found=repr(changed.now),
                        expected=repr(changed.before), fix=_ELSEWHERE)


def _compare(field: str, before: Mapping[str, Any], now: Mapping[str, Any], where: str, fix: str) -> None:
    for name in sorted({*before, *now}):
        if before.get(name) != now.get(name):
            raise OcnfError("not the one the folder was begun with", code="changed", where=where,
                            field=f"{field}.{name}", found=now.get(name, "absent"),
                            expected=before.get(name, "absent"), fix=fix)


def _places(plan: Plan) -> set[tuple[str, str]]:
    return {(item.split, item.source) for item in plan.items}


def _compare_items(begun: Plan, plan: Plan, where: str) -> None:
    ours, theirs = (sorted({item.split for item in one.items}) for one in (plan, begun))
    if ours != theirs:
        raise OcnfError("the folder was begun with other splits", code="changed", where=where, field="splits",
                        found=", ".join(ours), expected=", ".join(theirs), fix=_ELSEWHERE)
    then = {(item.split, item.source): item for item in begun.items}
    now = {(item.split, item.source): item for item in plan.items}
    for (split, source), item in then.items():
        found = now.get((split, source))
        what = "scan" if is_configuration(source) else "shape" if is_procedural(source) else "mesh"
        if found is None:
            raise OcnfError(f"a {what} of {split} is gone", code="changed", where=where, field=source,
                            found="no file", expected=f"sha256 {item.sha256}", fix=_ELSEWHERE)
        # A file that could not be read when the plan was made may be by now: --retry-failed picks it up.
        if item.sha256 is not None and found.sha256 != item.sha256:
            raise OcnfError(f"a {what} of {split} has changed", code="changed", where=where, field=source,
                            found=f"sha256 {found.sha256}" if found.sha256 else "an unreadable file",
                            expected=f"sha256 {item.sha256}", fix=_ELSEWHERE)
    for (split, source) in now.keys() - then.keys():
        raise OcnfError(f"a mesh of {split} is new", code="changed", where=where, field=source,
                        found="a file", expected="none", fix=_ELSEWHERE)
