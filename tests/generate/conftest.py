"""Fixtures of the generation tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _fake_makers_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Children inherit the import path, so `fake_makers:maker` resolves in them too."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
