"""What the command lines share: an error or an interrupt is one sentence; an option is given
once; the version; narrow tables.

An error ends a command with exit status 1, Ctrl-C with 130, SIGTERM with 143.
"""

from __future__ import annotations

import functools
import os
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any, ParamSpec

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from typer.core import TyperCommand

from ocnf_data.errors import OcnfError
from ocnf_data.files import interrupts
from ocnf_data.version import __version__

P = ParamSpec("P")


def print_error(sentence: str, console: Console) -> None:
    """Print a sentence as an error, unbroken and letter by letter."""
    console.print(f"[red]error:[/] {escape(sentence)}", highlight=False, soft_wrap=True)


def check_up(up: str) -> None:
    """Raise OcnfError unless `--up` names an axis that can point up in a picture."""
    if up not in ("y", "z"):
        raise OcnfError("not an axis that can point up", field="--up", found=up, expected="y or z")


def stoppable(console: Console, sentence: str) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Decorate a command: where it is stopped, it says in one line what is kept and how to go on.

    Args:
        console: where the sentence is printed.
        sentence: what to say after `stopped`, with the command's arguments in braces; an interrupt that has
            words of its own is given with those.
    """
    def decorate(command: Callable[P, None]) -> Callable[P, None]:
        @functools.wraps(command)
        def stopping(*args: P.args, **kwargs: P.kwargs) -> None:
            try:
                command(*args, **kwargs)
            except (KeyboardInterrupt, SystemError) as stop:
                if not interrupts.is_interrupt(stop):
                    raise
                words = str(stop) if isinstance(stop, KeyboardInterrupt) else ""
                _say_stopped(words or f"stopped; {sentence.format(**kwargs)}", console)
                raise typer.Exit(interrupts.exit_status()) from None

        return stopping

    return decorate


def run_app(app: typer.Typer, console: Console, debug: Callable[[], bool]) -> None:
    """Run a command line; where `debug()` holds afterwards, an error is raised with its traceback."""
    interrupts.listen()
    try:
        app()
    except OcnfError as error:
        if debug():
            raise
        print_error(str(error), console)
        sys.exit(1)
    except (KeyboardInterrupt, SystemError) as error:  # before the command began, or after it ended
        if not interrupts.is_interrupt(error):
            raise
        sys.exit(interrupts.exit_status())


def show_version(wanted: bool) -> None:
    """What `--version` of either command line does."""
    if wanted:
        typer.echo(f"ocnf {__version__}")
        raise typer.Exit


class GivenOnce(TyperCommand):
    """A command whose options are given once: by itself it would take the last of several, in silence."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse an option of one value that is given again, in whatever spelling."""
        _, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for option, n in Counter[Any](order).items():
            if n > 1 and not option.multiple and not option.is_flag:
                raise OcnfError("given more than once", field=option.opts[0], found=f"{n} times",
                                expected="once", fix="run the command once for each value")
        return super().parse_args(ctx, args)


def narrow_table(title: str) -> Table:
    """A table without borders, of which ten columns of figures fit into 80 characters."""
    return Table(title=title, title_justify="left", box=box.SIMPLE, padding=0, pad_edge=False)


def _say_stopped(sentence: str, console: Console) -> None:
    if os.environ.get("RANK", "0") == "0":  # of processes that train together one speaks
        console.print(f"[yellow]{escape(sentence)}[/]", highlight=False, soft_wrap=True)
