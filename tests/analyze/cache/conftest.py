"""A cache of its own for every test, for stores that were written a moment ago."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_attention.analyze.cache import remembered


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("VLA_CACHE", str(folder))
    monkeypatch.setattr(remembered, "SETTLED_SECONDS", 0.0)
    return folder
