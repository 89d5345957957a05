"""A state is taken where it fits, and refused by field where it does not."""

from __future__ import annotations

import json

import pytest

from ocnf_data.errors import OcnfError
from ocnf_data.loading.cursor import Position
from ocnf_data.loading.loader_state import make_state, read_state

ORDER = {"seed": 0, "split": "train", "batch_size": 4, "datasets": ["ab", "cd"], "variant": None,
         "shuffle": True}


def test_state_is_json_and_comes_back():
    state = make_state(Position(3, 120), ORDER)
    assert read_state(json.loads(json.dumps(state)), ORDER) == (3, 120)


@pytest.mark.parametrize(("field", "value"), [
    ("seed", 1), ("split", "test"), ("batch_size", 8), ("datasets", ["cd", "ab"]), ("variant", "v4"),
    ("schema", 2), ("shuffle", 1),
])
def test_a_field_that_differs_is_named_with_both_values(field, value):
    state = make_state(Position(0, 0), ORDER) | {field: value}
    with pytest.raises(OcnfError) as caught:
        read_state(state, ORDER)
    assert caught.value.field == field and caught.value.code == "state"
    assert str(value) in caught.value.found
    assert str(make_state(Position(0, 0), ORDER)[field]) in caught.value.expected


@pytest.mark.parametrize("field", ["schema", "epoch", "step", *ORDER])
def test_a_missing_field_is_named(field):
    state = make_state(Position(0, 0), ORDER)
    del state[field]
    with pytest.raises(OcnfError) as caught:
        read_state(state, ORDER)
    assert caught.value.field == field


@pytest.mark.parametrize(("field", "value"), [("epoch", -1), ("step", 1.0), ("step", True), ("epoch", "3")])
def test_places_that_are_none_are_refused(field, value):
    with pytest.raises(OcnfError, match=field):
        read_state(make_state(Position(0, 0), ORDER) | {field: value}, ORDER)


def test_unknown_fields_and_other_things_are_refused():
    with pytest.raises(OcnfError, match="colour"):
        read_state(make_state(Position(0, 0), ORDER) | {"colour": 1}, ORDER)
    with pytest.raises(OcnfError, match="not a state"):
        read_state([1, 2], ORDER)
