"""The count is live and never falls, whoever does the work."""

from __future__ import annotations

import io
import time
from pathlib import Path

from rich.console import Console

from ocnf_data.files.storage import Store
from ocnf_data.generation import progress
from ocnf_data.generation.progress import LiveCount, ProgressDisplay, live_folder


def console(terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=120)


def text(shown: Console) -> str:
    assert isinstance(shown.file, io.StringIO)
    return shown.file.getvalue()


def test_items_count_before_their_shard_is_done(tmp_path: Path) -> None:
    display = ProgressDisplay(10, tmp_path, console(False))
    with LiveCount(str(tmp_path), "train-000000") as live:
        live.count(failed=False)
        live.count(failed=True)
        assert display.counts() == (2, 1)
        live.count(failed=False)
    assert display.counts() == (3, 1)
    display.shard_finished("train-000000", 4, 1)
    assert display.counts() == (4, 1)


def test_without_a_folder_it_counts_shards(tmp_path: Path) -> None:
    display = ProgressDisplay(10, None, console(False))
    with LiveCount(None, "train-000000") as live:
        live.count(failed=False)
    assert display.counts() == (0, 0)
    display.shard_finished("train-000000", 4, 1)
    assert display.counts() == (4, 1)


def test_a_bar_on_a_terminal_and_lines_elsewhere(monkeypatch) -> None:
    monkeypatch.setattr(progress, "_PLAIN_SECONDS", 0.02)
    terminal, plain = console(True), console(False)
    for shown in (terminal, plain):
        display = ProgressDisplay(8, None, shown)
        with display.shown():
            display.shard_finished("train-000000", 4, 2)
            time.sleep(0.2)
    assert "4/8" in text(terminal)
    assert "2 failed" in text(terminal)
    assert "4 of 8 items" in text(plain)
    assert "\x1b" not in text(plain)


def test_the_folder_is_there_for_local_workers_only(tmp_path: Path) -> None:
    with live_folder(Store(tmp_path), shared=False) as folder:
        assert folder is not None
        folder.mkdir()
        assert folder.parent == tmp_path
    assert not folder.exists()
    with live_folder(Store("memory://x"), shared=True) as folder:
        assert folder is not None
    with live_folder(Store("memory://x"), shared=False) as folder:
        assert folder is None
