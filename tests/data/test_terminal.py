"""A command that is stopped ends with one sentence, wherever the signal found it."""

from __future__ import annotations

import io

import pytest
import typer
from rich.console import Console

from ocnf_data.terminal import stoppable


def interrupted_in_compiled_code() -> None:
    """What the interpreter makes of a signal that arrives as a compiled function returns."""
    within = SystemError("a function returned a result with an exception set")
    within.__cause__ = KeyboardInterrupt()
    raise SystemError("another returned a result with an exception set") from within


def interrupted() -> None:
    raise KeyboardInterrupt


def interrupted_with_words() -> None:
    raise KeyboardInterrupt("stopped in the middle")


@pytest.mark.parametrize(("stop", "said"), [
    (interrupted, "stopped; it goes on in OUT\n"), (interrupted_with_words, "stopped in the middle\n"),
    (interrupted_in_compiled_code, "stopped; it goes on in OUT\n")])
def test_an_interrupt_is_a_sentence(stop, said) -> None:
    console = Console(record=True, file=io.StringIO())

    @stoppable(console, "it goes on in {out}")
    def command(out: str) -> None:
        stop()

    with pytest.raises(typer.Exit) as end:
        command(out="OUT")
    assert end.value.exit_code == 130
    assert console.export_text() == said


def test_another_error_of_the_interpreter_is_none() -> None:
    @stoppable(Console(), "")
    def command() -> None:
        raise SystemError("bad internal call") from ValueError()

    with pytest.raises(SystemError, match="bad internal call"):
        command()
