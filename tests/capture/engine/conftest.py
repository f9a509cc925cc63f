"""Captures without a simulator of their own."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tests.capture.engine.simulators_in_threads import simulators_in_threads


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Simulators are threads; `scene.make` makes the environment of each."""
    return simulators_in_threads(monkeypatch)
