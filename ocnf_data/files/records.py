"""Canonical JSON and strict records: one text for a value, and nothing accepted but that text."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Final, Self

from pydantic import ConfigDict, Field, ValidationError

from ocnf_data.errors import OcnfError
from ocnf_data.files.validation import Strict, translate

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0, le=2**53)]
Text = Annotated[str, Field(max_length=1024)]

SCHEMA_VERSION: Final = 1


def sha256_hex(data: bytes | bytearray | memoryview) -> str:
    """SHA-256 in hexadecimal (about 0.5 ms a megabyte on one core with SHA instructions)."""
    return hashlib.sha256(data).hexdigest()


def canonical_json(value: Any, indent: int | None = None) -> bytes:
    """The one text of a JSON value: keys sorted, ASCII, no NaN, one newline at the end."""
    separators = (",", ":") if indent is None else (",", ": ")
    text = json.dumps(value, sort_keys=True, allow_nan=False, indent=indent, separators=separators)
    return text.encode("ascii") + b"\n"


class Record(Strict):
    """A record in a file of its own or within another: no converted types, one text for a value."""

    model_config = ConfigDict(strict=True, populate_by_name=True)

    def to_json(self) -> bytes:
        """The record's file: canonical JSON."""
        return canonical_json(self.model_dump(mode="json", by_alias=True))

    @classmethod
    def from_json(cls, blob: bytes, where: object, max_bytes: int = 64 * 2**20) -> Self:
        """Read a record from the bytes of its file.

        Raises:
            OcnfError: code `schema` for another version of the format, `too_large`, else `invalid`: not JSON,
                a missing, unknown or impossible field, or not the canonical text.
        """
        if len(blob) > max_bytes:
            raise OcnfError("the file is too large", code="too_large", where=where, found=len(blob),
                            expected=f"at most {max_bytes} bytes")
        try:
            record = cls.model_validate_json(blob)
        except ValidationError as error:
            _check_schema(error, where)
            raise translate(error, cls, where, "invalid") from None
        try:
            canonical = record.to_json()
        except ValueError as error:  # NaN, which JSON has not
            raise OcnfError("not JSON", where=where, found=error) from None
        if canonical != blob:
            raise OcnfError("not the text that was written: damaged, or changed by hand", code="checksum",
                            where=where, fix="`ocnf-data repair` writes the file again")
        return record


def _check_schema(error: ValidationError, where: object) -> None:
    """Raise for another version of the format alone: that explains whatever else is wrong."""
    for one in error.errors(include_url=False, include_context=False):
        if one["loc"] == ("schema",) and one["type"] != "missing":
            raise OcnfError("the data set has another schema version", code="schema", where=where,
                            field="schema", found=one["input"], expected=SCHEMA_VERSION,
                            fix="read it with the version of ocnf that wrote it, or generate it again")
