"""The page as a file: what it says, and the writer that puts it together sample by sample.

One file as long as it stays below `LARGEST`; beyond that geometry goes to a folder beside it, a script for
each sample, which the page loads when the sample is opened. (A page that is opened from the disk may not
`fetch` a file beside it, but it may load a script.)
"""

from __future__ import annotations

import base64
import html
import json
import re
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from ocnf_data.errors import OcnfError
from ocnf_data.files.storage import Store
from ocnf_data.files.storage_errors import storage_errors
from ocnf_data.render.pictures import DISTANCE_COLOURS
from ocnf_data.report.contents import ERROR_COLOURS, Card, Scale

LARGEST = 50_000_000
"""Bytes of a page that is still one file."""
_SCRIPTS = ("three.min.js", "blob.js", "tables.js", "gallery.js", "viewer.js", "flat.js", "page.js")
_GEOMETRY = re.compile(r"[0-9]{6}\.js", re.ASCII)


@dataclass(frozen=True)
class PageTable:
    """A table: text or numbers.

    Attributes:
        title: stands above it.
        head: names of the columns.
        rows: text, numbers, or None for what is not known.
        note: stands below it.
        bars: numbers of columns that are drawn as bars too.
        total: whether the last row sums up the others, and stays the last.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str | float | None]]
    note: str = ""
    bars: Sequence[int] = ()
    total: bool = False


@dataclass(frozen=True)
class Column:
    """A number that each sample has: the gallery is sorted by it."""

    label: str
    unit: str = ""
    digits: int = 1

    @property
    def heading(self) -> str:
        """What stands above the column in a table."""
        return f"{self.label}, {self.unit}" if self.unit else self.label


@dataclass
class Page:
    """What a page says beside its samples.

    Attributes:
        title, subtitle: its head.
        scale: of positions and error colours.
        columns: what the samples' values are.
        up: the axis that points up, y or z.
        group: what the samples' `split` is called, where it is something else.
        facts: (name, value) pairs for the line below the head.
        tables: of the tab `Statistics`.
        failures: of the tab `Failures`; None: the page has no such tab.
        provenance: (title, text) of the tab `Provenance`.
        notes: sentences that a reader has to know.
    """

    title: str
    subtitle: str
    scale: Scale
    columns: Sequence[Column]
    up: str = "z"
    group: str = "Split"
    facts: list[tuple[str, str]] = field(default_factory=list)
    tables: list[PageTable] = field(default_factory=list)
    failures: PageTable | None = None
    provenance: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class PageWriter:
    """Takes the samples in the order of the gallery, and writes the page at the end.

    Args:
        path: the HTML file. Geometry that is too much for it goes to a folder of its name and `_files`.
        largest: bytes of the one file, roughly.

    Raises:
        OcnfError: the name does not end in .html, or the folder cannot be written.
    """

    def __init__(self, path: Path, largest: int = LARGEST) -> None:
        if path.suffix.lower() not in (".html", ".htm"):
            raise OcnfError("not the name of a page", where=path, found=path.suffix or "no suffix",
                            expected=".html", fix=f"call it {path.name}.html")
        if path.is_dir():
            raise OcnfError("a folder has that name", where=path, expected="a file", fix="name another file")
        with storage_errors(path):  # now, not when all samples have been drawn
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path.parent):
                pass
        self.path, self.folder = path, f"{path.stem}_files"
        self._store, self._largest = Store(path.parent), largest
        self._rows: list[dict[str, Any]] = []
        self._held: list[str] = []
        self._size = sum(len(_asset(name)) for name in _SCRIPTS)
        self._is_split = False

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, card: Card) -> None:
        """Add a sample. What no longer fits into one file is written at once."""
        thumbnail = base64.b64encode(card.thumbnail).decode("ascii")
        self._rows.append({"key": card.key, "split": card.split, "category": card.category,
                           "source": card.source, "values": card.values, "thumbnail": thumbnail})
        self._size += len(thumbnail) + len(card.blob)
        self._held.append(card.blob)
        if self._is_split or self._size > self._largest:
            self._is_split = True
            first = len(self._rows) - len(self._held)
            for number, blob in enumerate(self._held, first):
                script = f"ocnfReceive({number},{_script_json(self._rows[number]['key'])},\"{blob}\")\n"
                self._store.put_bytes(f"{self.folder}/{number:06d}.js", script.encode())
            self._held.clear()

    def finish(self, page: Page) -> list[Path]:
        """Write the page; the paths of the page and, if there is one, of the folder beside it."""
        data = {**asdict(page), "scale": page.scale._asdict(), "samples": self._rows,
                "folder": self.folder if self._is_split else None, "distanceColours": DISTANCE_COLOURS,
                "errorColours": ERROR_COLOURS}
        self._remove_older()
        geometry = "".join(f'<script type="text/plain" id="geometry-{number}">{blob}</script>\n'
                           for number, blob in enumerate(self._held)) if not self._is_split else ""
        parts = {
            "title": html.escape(page.title),
            "style": _asset("page.css"),
            "data": f'<script type="application/json" id="page-data">{_script_json(data)}</script>',
            "geometry": geometry,
            "scripts": "\n".join(f"<script>\n{_script(name)}</script>" for name in _SCRIPTS),
        }
        text = re.sub(r"<!-- ([a-z]+) -->", lambda found: parts[found[1]], _asset("page.html"))
        self._store.put_bytes(self.path.name, text.encode())
        return [self.path, *([self.path.parent / self.folder] if self._is_split else [])]

    def _remove_older(self) -> None:
        """Delete the geometry of an older page of this name that this one does not have."""
        folder = self.path.parent / self.folder
        if not folder.is_dir():
            return
        kept = len(self._rows) if self._is_split else 0
        with storage_errors(folder):
            for file in folder.iterdir():
                if _GEOMETRY.fullmatch(file.name) and int(file.stem) >= kept:
                    file.unlink()
            if not any(folder.iterdir()):
                folder.rmdir()


def _asset(name: str) -> str:
    return files("ocnf_data.report").joinpath("assets", name).read_text(encoding="utf-8")


def _script(name: str) -> str:
    """A script; three.js with its licence, which wants to be in every copy."""
    licence = f"/*\n{_asset('three-LICENSE.txt')}*/\n" if name == _SCRIPTS[0] else ""
    return licence + _asset(name)


def _script_json(value: Any) -> str:
    """JSON that may stand inside a script: nothing in it ends the script or begins a comment."""
    text = json.dumps(value, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")
