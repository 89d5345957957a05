"""How far a run is: items done, rate, failures, time left.

Workers that share a disk with the driver count each finished item in a small file of their shard; the driver
looks at those files twice a second. Elsewhere the count moves shard by shard. (A manager's queue costs more
an item, a process of 20 MB, and an error in every worker when it dies: docs/decisions.md.)
"""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ocnf_data.files.storage import Store

_LIVE = ".progress"
_LOOK_SECONDS = 0.5
_PLAIN_SECONDS = 30.0


class LiveCount:
    """A worker's side: one byte a finished item, `.` or `!`, in `folder/shard`; no folder, no count."""

    def __init__(self, folder: str | None, shard: str) -> None:
        self._path = None if folder is None else Path(folder) / shard

    def __enter__(self) -> LiveCount:
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._path.write_bytes(b"")
        return self

    def count(self, failed: bool) -> None:
        """One more item is done with."""
        if self._path is not None:
            with self._path.open("ab") as file:
                file.write(b"!" if failed else b".")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Leave the file: the driver removes it once it has heard of the shard, so the count never falls."""


class ProgressDisplay:
    """The driver's side.

    Args:
        total: items that this run has to do.
        live: the folder that workers count in, or None.
        console: where to draw; on anything but a terminal a plain line appears now and then.
    """

    def __init__(self, total: int, live: Path | None, console: Console) -> None:
        self.total = total
        self._live = live
        self._console = console
        self._done = 0
        self._failed = 0
        self._begin = time.monotonic()
        self._lock = threading.Lock()

    def shard_finished(self, name: str, items: int, failed: int) -> None:
        """A shard is in its place."""
        with self._lock:
            self._done += items
            self._failed += failed
            if self._live is not None:
                (self._live / name).unlink(missing_ok=True)

    def counts(self) -> tuple[int, int]:
        """(items done with, failures among them), shards in the making included."""
        with self._lock:
            done, failed = self._done, self._failed
            if self._live is not None and self._live.is_dir():
                for path in self._live.iterdir():
                    marks = path.read_bytes()
                    done += len(marks)
                    failed += marks.count(b"!")
            return done, failed

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Draw until the block ends."""
        stop = threading.Event()
        draw = self._draw_bar if self._console.is_terminal else self._print_lines
        thread = threading.Thread(target=draw, args=(stop,), name="ocnf-progress", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()

    def _draw_bar(self, stop: threading.Event) -> None:
        columns = (TextColumn("generating"), BarColumn(), MofNCompleteColumn(),
                   TextColumn("{task.fields[rate]}"), TextColumn("{task.fields[failures]}"),
                   TimeRemainingColumn(compact=True))
        with Progress(*columns, console=self._console, speed_estimate_period=120) as progress:
            bar = progress.add_task("", total=self.total, rate="", failures="")
            while True:
                over = stop.wait(_LOOK_SECONDS)
                done, failed = self.counts()
                progress.update(bar, completed=done, rate=f"{self._per_minute(done):.1f}/min",
                                failures=f"[red]{failed} failed[/]" if failed else "0 failed")
                if over:
                    return

    def _print_lines(self, stop: threading.Event) -> None:
        while not stop.wait(_PLAIN_SECONDS):
            done, failed = self.counts()
            rate = self._per_minute(done)
            left = f"{(self.total - done) / rate:.0f} min left" if rate else "no estimate yet"
            self._console.print(f"{done} of {self.total} items, {rate:.1f}/min, {failed} failed, {left}")

    def _per_minute(self, done: int) -> float:
        return 60 * done / max(time.monotonic() - self._begin, 1e-9)


@contextmanager
def live_folder(store: Store, shared: bool) -> Iterator[Path | None]:
    """A folder in which workers count items: beside the shards, or on this machine if they run on it.

    Args:
        store: the data set.
        shared: workers see this machine's disk.
    """
    if store.root is not None:
        folder = store.root / _LIVE
    elif shared:
        folder = Path(tempfile.mkdtemp(prefix="ocnf-progress-"))
    else:
        yield None
        return
    shutil.rmtree(folder, ignore_errors=True)  # of a run that was killed
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
