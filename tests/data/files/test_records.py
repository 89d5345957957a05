"""A record's file: one text for a value, and a message that names field, value and what is allowed."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import pytest
from pydantic import Field, model_validator

from ocnf_data.errors import OcnfError
from ocnf_data.files.records import SCHEMA_VERSION, Count, Record, Sha256, canonical_json

GOOD = "0" * 64


class Part(Record):
    """A record within another."""

    size: Annotated[Count, Field(alias="bytes")]
    sha256: Sha256


class Whole(Record):
    """A file."""

    schema_version: Annotated[Literal[1], Field(alias="schema")] = SCHEMA_VERSION
    parts: Annotated[tuple[Part, ...], Field(max_length=50)]
    total: Count

    @model_validator(mode="after")
    def _adds_up(self) -> Self:
        if sum(part.size for part in self.parts) != self.total:
            raise ValueError(f"total is {self.total}, the parts hold something else")
        return self


def body(**changes: object) -> dict[str, object]:
    parts = [{"bytes": 3, "sha256": GOOD}, {"bytes": 4, "sha256": GOOD}]
    return {"schema": 1, "parts": parts, "total": 7, **changes}


def refusal(blob: bytes) -> OcnfError:
    with pytest.raises(OcnfError) as caught:
        Whole.from_json(blob, "set/whole.json", 10_000)
    assert caught.value.where == "set/whole.json"
    assert "Input should" not in str(caught.value)
    return caught.value


def test_round_trip() -> None:
    whole = Whole.from_json(canonical_json(body()), "set/whole.json")
    assert whole.to_json() == canonical_json(body())


@pytest.mark.parametrize(("changes", "message"), [
    ({"total": "7"}, "set/whole.json: total: the value is not allowed; found '7', expected a valid integer"),
    ({"total": -1}, "total: the value is not allowed; found -1, expected greater than or equal to 0"),
    ({"total": True}, "total: the value is not allowed; found True, expected a valid integer"),
    ({"total": 8}, "set/whole.json: total is 8, the parts hold something else"),
    ({"parts": 3}, "parts: the value is not allowed; found 3, expected a valid array"),
    ({"parts": [{"bytes": 7, "sha256": "xyz"}]},
     "parts[0].sha256: the value is not allowed; found 'xyz', expected text that matches pattern"),
    ({"parts": [{"bytes": 7}]}, "parts[0].sha256: the field is missing"),
    ({"parts": [{"bytes": 7, "sha256": GOOD, "crc": 1}]},
     "parts[0].crc: unknown field; expected one of bytes, sha256"),
    ({"parts": [{"bytes": 0, "sha256": GOOD}] * 51}, "parts: the value is not allowed; found [{"),
])
def test_a_refusal_names_field_value_and_what_is_allowed(changes: dict[str, object], message: str) -> None:
    error = refusal(canonical_json(body(**changes)))
    assert message in str(error)
    assert error.code == "invalid"


@pytest.mark.parametrize("blob", [b"", b"{", b"\xff", canonical_json(body())[:-3], b"[" * 5000])
def test_what_is_not_json(blob: bytes) -> None:
    error = refusal(blob)
    assert "not JSON" in str(error)
    assert len(str(error)) < 300


def test_another_version_is_all_that_is_said() -> None:
    error = refusal(canonical_json(body(schema=2, total=-1, colour="red")))
    assert (error.code, error.field, error.found, error.expected) == ("schema", "schema", "2", "1")


def test_thousands_of_wrong_fields_stay_readable() -> None:
    error = refusal(canonical_json(body(parts=[{"bytes": -1, "sha256": GOOD}] * 50)))
    assert str(error).startswith("set/whole.json: 50 fields are wrong:\n  parts[0].bytes: ")
    assert str(error).endswith("\n  and 30 more")


def test_another_text_of_the_same_value_is_refused() -> None:
    error = refusal(canonical_json(body()).replace(b",", b", "))
    assert error.code == "checksum"
