"""What a long command is doing: a line a stage, with its time, and progress within it.

Each stage begins when the one before ends, so that the times add up to what a clock on the wall shows.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

_PLAIN_SECONDS = 10.0
_NAME_WIDTH = 8


class StageLine:
    """One stage while it runs."""

    def __init__(self, name: str, console: Console | None, bar: Progress | None) -> None:
        self.name, self.text = name, ""
        self._console, self._bar = console, bar
        self._task: TaskID | None = None if bar is None else bar.add_task(name, total=None)
        self._spoke = time.perf_counter()

    def report(self, done: int, total: int) -> None:
        """So many of so many are done: moves the bar, or prints a line now and then where there is none."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, total=total)
        elif self._console is not None and time.perf_counter() - self._spoke > _PLAIN_SECONDS:
            self._spoke = time.perf_counter()
            self._console.print(f"{self.name:<{_NAME_WIDTH}} {done} of {total}", highlight=False)

    def say(self, text: str) -> None:
        """What the stage's line says in the end."""
        self.text = text


class StageLog:
    """The stages of a command, each with its line.

    Args:
        console: where the lines go; None: nowhere.
        began: `time.perf_counter()` when the command began, in place of now.

    Attributes:
        seconds: the stages' names and times in seconds, in order.
    """

    def __init__(self, console: Console | None = None, began: float | None = None) -> None:
        self.console = console
        self._began = time.perf_counter() if began is None else began
        self._last = self._began
        self.seconds: list[tuple[str, float]] = []
        self._noted: set[str] = set()

    @contextmanager
    def stage(self, name: str) -> Iterator[StageLine]:
        """Run a stage; its line is printed when it ends, not if it raises."""
        console = self.console
        if console is not None and console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(),
                       TimeElapsedColumn())
            with Progress(*columns, console=console, transient=True) as bar:
                stage = StageLine(name, console, bar)
                yield stage
        else:
            stage = StageLine(name, console, None)
            yield stage
        self.ended(name, stage.text)

    def ended(self, name: str, text: str) -> None:
        """A stage that began when the one before it ended is over."""
        now = time.perf_counter()
        self.seconds.append((name, now - self._last))
        if self.console is not None:
            self.console.print(f"{name:<{_NAME_WIDTH}} {now - self._last:6.1f} s  {text}".rstrip(),
                               highlight=False, markup=False, soft_wrap=True)
        self._last = now

    def note(self, sentences: Iterable[str], kind: str = "Note") -> None:
        """Print sentences, a line each, but none twice."""
        for sentence in sentences:
            if self.console is not None and sentence not in self._noted:
                self.console.print(f"{kind}: {sentence}", highlight=False, markup=False, soft_wrap=True)
            self._noted.add(sentence)

    @property
    def total(self) -> float:
        """Seconds of all stages together: those since the command began."""
        return self._last - self._began
