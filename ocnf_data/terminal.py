"""What the command lines share: errors as one red sentence and exit status 1, the version, narrow tables."""

from __future__ import annotations

import sys
from collections.abc import Callable

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ocnf_data.errors import OcnfError
from ocnf_data.version import __version__


def print_error(sentence: str, console: Console) -> None:
    """Print a sentence as an error, unbroken and letter by letter."""
    console.print(f"[red]error:[/] {escape(sentence)}", highlight=False, soft_wrap=True)


def run_app(app: typer.Typer, console: Console, debug: Callable[[], bool]) -> None:
    """Run a command line; where `debug()` holds afterwards, an error is raised with its traceback."""
    try:
        app()
    except OcnfError as error:
        if debug():
            raise
        print_error(str(error), console)
        sys.exit(1)


def show_version(wanted: bool) -> None:
    """What `--version` of either command line does."""
    if wanted:
        typer.echo(f"ocnf {__version__}")
        raise typer.Exit


def narrow_table(title: str) -> Table:
    """A table without borders, of which ten columns of figures fit into 80 characters."""
    return Table(title=title, title_justify="left", box=box.SIMPLE, padding=0, pad_edge=False)
