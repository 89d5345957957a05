"""Small text files of scans: matrices, tables of numbers, JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ocnf_data.arrays import F64
from ocnf_data.errors import OcnfError
from ocnf_data.files.storage_errors import storage_errors

_MAX_BYTES = 64 * 2**20  # an hour of poses at 100 Hz takes 30 MB
_PLAIN = "numbers apart by spaces or line breaks, without commas, comments or words"


def read_text(file: Path) -> str:
    """The file as text.

    Raises:
        OcnfError: it is missing, too large, or not ASCII or UTF-8.
    """
    with storage_errors(file), file.open("rb") as opened:
        data = opened.read(_MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise OcnfError("too large for text", code="too_large", where=file,
                        expected=f"at most {_MAX_BYTES} bytes")
    try:
        return data.decode("utf-8-sig")  # some editors begin a file with the mark of its encoding
    except UnicodeDecodeError as error:
        raise OcnfError("not a text file", code="unreadable", where=file, found=data[:20]) from error


def read_matrix(file: Path, *shape: int) -> F64:
    """The numbers of a file, whatever its line breaks, row by row in an array of `shape`; NaN is a number.

    Raises:
        OcnfError: something that is no number (with its line), or another count of them.
    """
    found = [numbers(line.split(), file, i) for i, line in enumerate(read_text(file).splitlines(), 1)]
    flat = [value for row in found for value in row]
    size = "x".join(map(str, shape))
    if len(flat) != np.prod(shape):
        raise OcnfError("wrong size of matrix", where=file, found=f"{len(flat)} numbers", expected=size)
    return np.array(flat).reshape(shape)


def read_table(file: Path, comment: str = "#") -> Iterator[tuple[int, list[str]]]:
    """(line, its words) of each line that is neither blank nor a comment; lines count from 1."""
    for i, line in enumerate(read_text(file).splitlines(), 1):
        words = line.split()
        if words and not words[0].startswith(comment):
            yield i, words


def numbers(words: list[str], file: Path, line: int) -> list[float]:
    """The words as numbers.

    Raises:
        OcnfError: a word that is none: a comment, a comma.
    """
    values = []
    for word in words:
        try:
            values.append(float(word))
        except ValueError as error:
            raise OcnfError("not a file of numbers", code="unreadable", where=file, field=f"line {line}",
                            found=repr(word[:40]), expected=_PLAIN) from error
    return values


def read_json(file: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        OcnfError: not JSON (with line and column), or not an object.
    """
    text = read_text(file)
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise OcnfError(f"not valid JSON: {error.msg}", code="unreadable", where=file,
                        field=f"line {error.lineno}, column {error.colno}") from error
    except (RecursionError, ValueError) as error:  # ValueError: an integer of ten thousand digits
        raise OcnfError("not valid JSON: nested too deeply, or a number too long", code="unreadable",
                        where=file) from error
    if not isinstance(data, dict):
        raise OcnfError("not a JSON object", where=file, found=type(data).__name__, expected="{...}")
    return data


def json_array(value: Any, shape: tuple[int, ...], file: Path, field: str) -> F64:
    """A list of numbers, nested or flat, as an array of `shape`, row by row.

    Raises:
        OcnfError: something else, or numbers that do not fit the shape.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.size != np.prod(shape):
        raise OcnfError("not a matrix of numbers", where=file, field=field, found=value,
                        expected="x".join(map(str, shape)))
    return array.reshape(shape)
