"""The one error class: every message names what, where, what was found, what was expected, what to do."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_CARRIED = "parts of the OcnfError: "


class OcnfError(Exception):
    """Bad input, a damaged file, a setting that does not fit: anything that a user can correct.

    The message is a sentence built from the parts that are given:

    >>> print(OcnfError("resolution is not a multiple of 8", where="demo.yaml", field="resolutions[1]",
    ...                 found=100, expected="64, 128, 256 or 512", fix="round it to the next one"))
    demo.yaml: resolutions[1]: resolution is not a multiple of 8; found 100, expected 64, 128, 256 or 512. \
Round it to the next one.

    Args:
        what: what is wrong, as a clause without a final stop.
        code: a short machine-readable reason (`unreadable`, `empty`, `checksum`, ...), which is what
            `failures.jsonl` records.
        where: the file, URL or object concerned.
        field: the field, member or axis in it.
        found: the offending value (shortened to 200 characters).
        expected: what would have been right.
        fix: what the user can do about it, as a clause, perhaps with a command on a line of its own, to be
            pasted; with the code `missing_extra` that command alone.
    """

    def __init__(
        self,
        what: str,
        *,
        code: str = "invalid",
        where: object = None,
        field: str | None = None,
        found: object = None,
        expected: object = None,
        fix: str | None = None,
    ) -> None:
        self.what = printable(what)
        self.code = code
        self.where = None if where is None else printable(str(where))
        self.field = None if field is None else printable(field)
        self.found = None if found is None else _shorten(printable(str(found)))
        self.expected = None if expected is None else printable(str(expected))
        self.fix = fix
        super().__init__(self._message())

    def _message(self) -> str:
        head = ": ".join(part for part in (self.where, self.field, self.what) if part)
        facts = []
        if self.found is not None:
            facts.append(f"found {self.found}")
        if self.expected is not None:
            facts.append(f"expected {self.expected}")
        text = head + ("; " + ", ".join(facts) if facts else "")
        if self.fix and self.code == "missing_extra":
            text += f". Install it:\n{self.fix}"  # a command, on a line of its own, as it is to be pasted
        elif self.fix and "\n" in self.fix:
            text += f". {self.fix[:1].upper()}{self.fix[1:]}"
        elif self.fix:
            text += f". {self.fix[:1].upper()}{self.fix[1:]}."
        return text

    def replaced(self, **parts: Any) -> OcnfError:
        """The same error with other parts, by the names of the constructor's arguments."""
        return OcnfError(**{**self._parts(), **parts})

    def _parts(self) -> dict[str, Any]:
        return {name: getattr(self, name)
                for name in ("what", "code", "where", "field", "found", "expected", "fix")}

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep every part when the error crosses a process boundary (pickle would call `cls(message)`)."""
        state = (self.what, self.code, self.where, self.field, self.found, self.expected, self.fix)
        return _rebuild, (type(self), *state)


def missing_extra(what: str, extra: str, where: object = None) -> OcnfError:
    """The error for a library that is not installed, with the command that installs it as its last line.

    >>> print(missing_extra("reading images needs OpenCV", "fuse"))
    reading images needs OpenCV. Install it:
    pip install 'ocnf[fuse]'

    Args:
        what: what needs which library, as a clause.
        extra: the extra of this package that has it.
        where: the file or URL concerned.
    """
    return OcnfError(what, code="missing_extra", where=where, fix=f"pip install 'ocnf[{extra}]'")


def _rebuild(cls: type[OcnfError], what: str, code: str, where: str | None, field: str | None,
             found: str | None, expected: str | None, fix: str | None) -> OcnfError:
    return cls(what, code=code, where=where, field=field, found=found, expected=expected, fix=fix)


class _WorkerError(OcnfError):
    """An error on its way out of a `DataLoader`'s worker process.

    What torch sends to the main process is the class and the text of the traceback, and it raises there what
    the class makes of that text alone. So the text ends with the error's parts, and of it this class makes
    the `OcnfError` that was raised in the worker.
    """

    def __new__(cls, text: str) -> OcnfError:  # type: ignore[misc]
        traceback, _, parts = text.rpartition(_CARRIED)
        error = OcnfError(**json.loads(parts.splitlines()[0]))
        error.__cause__ = RuntimeError(traceback)  # for those who look for where in the code it was
        return error

    @classmethod
    def of(cls, error: OcnfError) -> OcnfError:
        """An error with the same parts and the same sentence; its traceback ends with the parts."""
        leaving = Exception.__new__(cls)
        leaving.__init__(**error._parts())  # type: ignore[misc]
        leaving.add_note(_CARRIED + json.dumps(error._parts()))
        return leaving

    def __reduce__(self) -> tuple[Any, ...]:
        return OcnfError.replaced(self).__reduce__()


@contextmanager
def whole_from_worker() -> Iterator[None]:
    """An OcnfError in here, in a `DataLoader`'s worker, is raised in the main process with all its parts."""
    try:
        yield
    except OcnfError as error:
        raise _WorkerError.of(error) from error


def printable(text: str) -> str:
    r"""The text with what cannot be written as UTF-8 spelled out: a file called b"\xe9.off" is `\xe9.off`.

    Python reads the bytes of a file's name that are not UTF-8 as lone surrogates, which no terminal and no
    JSON parser of another language takes.
    """
    if text.isascii():
        return text
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # a surrogate that stands for no byte, from an escape in YAML or JSON
        return text.encode("utf-8", "backslashreplace").decode()


def _shorten(text: str, limit: int = 200) -> str:
    return text if len(text) <= limit else text[: limit - 3] + "..."
