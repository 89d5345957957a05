"""The loader's state: a place in the order, and everything that the order depends on, by name.

    {"schema": 1, "epoch": 3, "step": 120, "seed": 0, "split": "train", "batch_size": 4, ...}

It is plain JSON. `step` is the next batch of a rank in the epoch. A state is only taken by a data set that
would meet the same samples in the same order.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from ocnf_data.errors import OcnfError
from ocnf_data.loading.cursor import Position

STATE_SCHEMA: Final = 1
_LARGEST = 2**62
_NEW = frozenset({"parts"})  # fields that states of earlier versions lack; they are not compared there


def make_state(position: Position, order: Mapping[str, Any]) -> dict[str, Any]:
    """The state that resumes at `position`.

    Args:
        position: the next batch.
        order: what the order depends on; JSON values.
    """
    return {"schema": STATE_SCHEMA, "epoch": position.epoch, "step": position.step, **order}


def read_state(state: Mapping[str, Any], order: Mapping[str, Any]) -> Position:
    """The place in a state, if the state fits.

    Raises:
        OcnfError: code `state`; names the first field that does not fit, with the value in the state
            ("found") and that of this data set ("expected").
    """
    if not isinstance(state, Mapping):
        raise _misfit("not a state of a ShardDataset", None, type(state).__name__, "a dict from state_dict()")
    expected = make_state(Position(0, 0), order)
    if state.get("schema") != STATE_SCHEMA:
        raise _misfit("the state has another schema version", "schema", state.get("schema"), STATE_SCHEMA)
    for field in (*expected, *(field for field in state if field not in expected)):
        if field not in state and field in _NEW:
            continue
        if field not in state:
            raise _misfit("the state lacks a field", field, "nothing", expected[field])
        if field not in expected:
            raise _misfit("the state has an unknown field", field, repr(state[field]), "nothing")
        if field in ("epoch", "step"):
            _check_count(field, state[field])
        elif state[field] != expected[field] or type(state[field]) is not type(expected[field]):
            raise _misfit("the state is of a run with another order of samples", field, repr(state[field]),
                          repr(expected[field]))
    return Position(state["epoch"], state["step"])


def _check_count(field: str, found: object) -> None:
    if isinstance(found, bool) or not isinstance(found, int) or not 0 <= found < _LARGEST:
        raise _misfit("not a count", field, repr(found), "an integer from 0")


def _misfit(what: str, field: str | None, found: object, expected: object) -> OcnfError:
    return OcnfError(what, code="state", where="the loader's state", field=field, found=found,
                     expected=expected)
