"""The examples in docstrings give what they print."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCES = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"):
           path.read_text(encoding="utf-8")
           for package in ("ocnf_data", "ocnf_model") for path in sorted((ROOT / package).rglob("*.py"))}
WITH_EXAMPLES = [name for name, source in SOURCES.items() if ">>> " in source]
SKIPPED = {name for name in WITH_EXAMPLES if "doctest: +SKIP" in SOURCES[name]}


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    result = doctest.testmod(importlib.import_module(name))
    assert result.failed == 0
    assert result.attempted > 0 or name in SKIPPED


def test_only_examples_that_need_a_data_set_are_skipped() -> None:
    assert {name.partition(".")[2] for name in SKIPPED} <= {
        "files.storage", "loading.batch", "loading.dataset", "loading.mixture", "shards.reader",
        "shards.writer", "synthesis.dataset", "training.run"}
